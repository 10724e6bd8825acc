"""Reconstructions of other programs become maps: read, placed, described, built; docs/export-formats.md."""
