"""A page on this machine in which a person picks the same spots in a photo of a map and in a scan."""
