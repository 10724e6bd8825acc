"""Worker processes: they decode and localise, and cost their own query alone when they end."""
