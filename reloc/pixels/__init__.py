"""Pixels of a photo that has been answered: what stands there on Earth, and what of a map shows there."""
