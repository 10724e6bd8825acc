"""Placing a map on Earth: by the photos' GPS, by ground control points, by a LiDAR scan."""
