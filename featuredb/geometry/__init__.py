"""Rotations, rigid and similarity transforms, cameras: pure functions and values, no I/O."""
