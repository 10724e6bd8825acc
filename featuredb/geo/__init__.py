"""Geodesy: the local metric frame, UTM, vertical datums, GeoPose, tiles. The only home of pyproj."""
