"""Keypoints of renders around the prior, pooled, and matched with those of the photo."""
