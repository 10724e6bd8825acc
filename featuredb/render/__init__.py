"""Pictures of point clouds: which points a camera sees, in colour, intensity, depth and by index."""
