"""Zenoh server: queries in, poses out."""
