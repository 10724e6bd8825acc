"""Subcommands of `featuredb` that `ingest` adds; what they need is imported when they run."""
