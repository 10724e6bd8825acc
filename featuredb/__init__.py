"""Geo-registered feature maps: value types, geodesy, features, store and index."""
