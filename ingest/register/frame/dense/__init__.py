"""Pieces of a rendering as templates in the photo: their places, the pose, and whether it is right."""
