"""Telemetry of a video: where the drone or camera was, from subtitles, GoPro's track, GPX or tables.

`read.py` is the way in: `telemetry_of_video` looks into a video and beside it, `read_telemetry` reads one
file. Each format has its module (`srt`, `gpmf`, `gpx`, `csv_table`) and hands raw columns to `assemble`,
which cleans them alike; what comes out is a `Telemetry` (`values.py`). Whatever the bytes are, the answer is
a `Telemetry` or a `TelemetryError`.
"""
