"""How noisy measured camera positions are, and what they say in an adjustment."""
