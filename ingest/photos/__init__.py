"""Photos of an ingest: files found and read, tables of photos, positions, cameras, copies."""
