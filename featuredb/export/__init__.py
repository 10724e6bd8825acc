"""Maps leave the house: what is selected, and how it is written for other systems. See docs/export.md."""
