"""Placing a reconstruction on Earth: by the photos' GPS."""
