"""The trajectory of a film: as a value, written, drawn, read back."""
