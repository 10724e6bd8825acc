"""Geodesy: the local metric frame, UTM, vertical datums, GeoPose, tiles. The only home of pyproj."""

from featuredb.geo.local_frame import LocalFrame

__all__ = ["LocalFrame"]
