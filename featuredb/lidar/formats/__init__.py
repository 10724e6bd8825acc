"""Files of scans, rasters of heights and ortho images: LAS, LAZ, GeoTIFF. The home of laspy and rasterio."""
