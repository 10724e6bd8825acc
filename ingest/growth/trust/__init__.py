"""Who says so: confirmation by independent sources, scans, known answers, promotion."""
