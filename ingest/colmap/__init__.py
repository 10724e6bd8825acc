"""COLMAP's database and reconstructions: read, adjusted, cut, and their covariances."""
