"""Where a frame starts: the placement of its map, a pose that a person gives, or picks in photo and scan."""
