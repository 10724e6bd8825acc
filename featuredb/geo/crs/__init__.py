"""Coordinate reference systems of files: what a scan, a survey or an image is in, and the way to UTM."""
