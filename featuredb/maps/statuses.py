"""What a map may be and what placed it, by name: what a help needs, so nothing heavy."""

from typing import Literal, get_args

MapMethod = Literal["gps", "lidar", "gcp", "map"]
MapStatus = Literal["quarantined", "active", "retired"]
UnplacedStatus = Literal["unplaced", "retired"]
MAP_METHODS: tuple[MapMethod, ...] = get_args(MapMethod)
MAP_STATUSES: tuple[MapStatus, ...] = get_args(MapStatus)
UNPLACED_STATUSES: tuple[UnplacedStatus, ...] = get_args(UnplacedStatus)
