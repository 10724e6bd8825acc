"""Writes the scan and the ortho image of a simulated world, and those of a town that is not there.

Needs the extra `lidar` for the files' formats.
"""

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

from featuredb.extras import require
from featuredb.simworld.laser.airborne import scan_town
from featuredb.simworld.laser.scan_options import AirborneScanOptions
from featuredb.simworld.ortho import OrthoOptions, make_ortho
from featuredb.simworld.town.scene import Scene
from featuredb.simworld.town.town import make_town
from featuredb.simworld.world import World, WorldOptions, open_world, town_of, write_world

SCAN_FILE, ORTHO_FILE = "scan.laz", "ortho.tif"
OTHER_SCAN_FILE, OTHER_ORTHO_FILE = "other_town_scan.laz", "other_town_ortho.tif"
_STAMP_FILE = "scan_world.json"
_FORMAT = 1  # raised when the same options give other files
_OTHER_TOWN = 2000  # added to the seed: neither this town nor that of the negative photos

Size = Literal["short", "full"]

_NEEDS = ("lidar", "A scan with an ortho image", "laspy", "lazrs", "rasterio")


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanWorldOptions:
    """A world with its scan and its ortho image.

    Attributes:
        world: the photos.
        scan, ortho: how the town is scanned and photographed from above, each on its own day.
    """

    world: WorldOptions = field(default_factory=WorldOptions)
    scan: AirborneScanOptions = field(default_factory=AirborneScanOptions)
    ortho: OrthoOptions = field(default_factory=OrthoOptions)

    def fingerprint(self) -> str:
        """Digest of what the files depend on."""
        options = asdict(self)
        options["world"].pop("workers")
        text = json.dumps([_FORMAT, options], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanWorld:
    """A world on disk with what was seen from the air.

    Attributes:
        world: photos and their truth.
        scan, ortho: LAZ with intensity only, and GeoTIFF, of the photos' town.
        other_scan, other_ortho: of another town at the same place on Earth: nothing registers to it.
    """

    world: World
    scan: Path
    ortho: Path
    other_scan: Path
    other_ortho: Path


def make_scan_world(out: Path, seed: int = 1, size: Size = "short", workers: int = 0) -> ScanWorld:
    """A world of a size with scan and ortho image, made in folder `out` unless it is there already.

    Raises:
        MissingExtraError: the packages of the extra `lidar` are not installed.
        OSError: the folder cannot be written.
    """
    world = WorldOptions.short(seed) if size == "short" else WorldOptions(seed=seed)
    return write_scan_world(out, ScanWorldOptions(world=replace(world, workers=workers)))


def write_scan_world(folder: Path, options: ScanWorldOptions) -> ScanWorld:
    """Write photos, scan and ortho image into `folder`; a folder that holds just these is left as it is.

    Raises:
        MissingExtraError: the packages of the extra `lidar` are not installed.
        OSError: the folder cannot be written.
    """
    folder = Path(folder)
    stamp, fingerprint = folder / _STAMP_FILE, options.fingerprint()
    if stamp.is_file() and json.loads(stamp.read_text())["fingerprint"] == fingerprint:
        return open_scan_world(folder)
    require(*_NEEDS)
    # The stamp comes last: a folder with it is complete.
    stamp.unlink(missing_ok=True)
    write_world(folder, options.world)
    write_lidar(folder, options)
    stamp.write_text(json.dumps({"fingerprint": fingerprint}) + "\n")
    return open_scan_world(folder)


def write_lidar(
    folder: Path, options: ScanWorldOptions, note: Callable[[str], None] = lambda name: None
) -> None:
    """Write the four files of ScanWorld; `note` gets each one's name before it is made.

    Raises:
        MissingExtraError: the packages of the extra `lidar` are not installed.
        OSError: the folder cannot be written.
    """
    require(*_NEEDS)
    from featuredb.lidar.formats.geotiff import write_geotiff
    from featuredb.simworld.laser.scan_file import write_scan

    Path(folder).mkdir(parents=True, exist_ok=True)
    for scene, scan_name, ortho_name in (
        (town_of(options.world), SCAN_FILE, ORTHO_FILE),
        (other_town_here(options.world), OTHER_SCAN_FILE, OTHER_ORTHO_FILE),
    ):
        note(scan_name)
        write_scan(folder / scan_name, scan_town(scene, options.scan))
        note(ortho_name)
        ortho = make_ortho(scene, options.ortho)
        write_geotiff(
            folder / ortho_name,
            ortho.rgb,
            epsg=ortho.epsg,
            west=ortho.west,
            north=ortho.north,
            pixel_m=ortho.pixel_m,
        )


def open_scan_world(folder: Path) -> ScanWorld:
    """A world with scan and ortho image that was written before.

    Raises:
        InvalidValueError: no truth.json there.
    """
    folder = Path(folder)
    return ScanWorld(
        world=open_world(folder),
        scan=folder / SCAN_FILE,
        ortho=folder / ORTHO_FILE,
        other_scan=folder / OTHER_SCAN_FILE,
        other_ortho=folder / OTHER_ORTHO_FILE,
    )


def other_town_here(options: WorldOptions) -> Scene:
    """A town of another seed at the very place of the world's town."""
    return make_town(options.seed + _OTHER_TOWN, name="other town, same place", size_m=options.town_size_m)
