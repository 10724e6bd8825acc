"""The cameras of the simulated world: from a scene to a photo with lens, noise and EXIF."""
