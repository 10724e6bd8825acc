"""Films and live video: frames with their times, writing films, telemetry beside them."""
