"""LiDAR scans: reading, cleaning, levels of detail, colours from an ortho image, the scans of a database."""
