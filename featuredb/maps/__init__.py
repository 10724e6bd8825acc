"""The feature map as a value."""
