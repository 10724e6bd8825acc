"""The report of an ingest: its values, the page, pictures."""
