"""A world with what was seen of its town from the air, for programs that anchor and track."""

from dataclasses import dataclass
from pathlib import Path

from featuredb.simworld.scan_world import OTHER_SCAN_FILE, SCAN_FILE, write_lidar
from featuredb.simworld.world import World, WorldOptions, open_world, write_world

_DONE = "scan_world.done"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanWorld:
    """A world on disk: photos and their truth; a LAZ of their town with intensity only; and one of another
    town at the same place on Earth, to which nothing registers."""

    world: World
    scan: Path
    other_scan: Path


def make_scan_world(inputs: Path, seed: int = 1) -> ScanWorld:
    """The world that `featuredb simworld --lidar --size short` writes, in a folder of `inputs`, made once."""
    folder, options = inputs / f"scan-world-{seed}", WorldOptions.short(seed)
    if not (folder / _DONE).exists():
        write_lidar(folder, options)
        write_world(folder, options)
        (folder / _DONE).touch()
    return ScanWorld(world=open_world(folder), scan=folder / SCAN_FILE, other_scan=folder / OTHER_SCAN_FILE)
