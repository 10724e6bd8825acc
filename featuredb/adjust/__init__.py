"""One least-squares problem for poses, points and lenses, and the covariances that come out of it."""
