"""Maps of street photos placed on a scan by what both have: outlines, ground and roofs."""
