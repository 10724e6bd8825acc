"""Maps that overlap, adjusted together: one bundle adjustment of all their photos."""
