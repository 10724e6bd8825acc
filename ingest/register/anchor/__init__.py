"""A map anchored on a scan, from proposed frames to the new placement and its pictures."""
