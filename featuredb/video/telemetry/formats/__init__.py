"""Files and tracks of telemetry, a module or a few for each format."""
