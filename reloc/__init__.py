"""Image, prior and maps to a pose: localisation, and the Zenoh service and client around it."""
