"""What image files say of a photo: EXIF, GPS, angles; read, and written."""
