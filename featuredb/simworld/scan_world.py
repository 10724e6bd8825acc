"""Writes the scan and the ortho image of a simulated world, and those of a town that is not there.

Needs the extra `lidar` for the files' formats.
"""

from collections.abc import Callable
from pathlib import Path

from featuredb.extras import require
from featuredb.simworld.laser.airborne import AirborneScanOptions, scan_town
from featuredb.simworld.ortho import OrthoOptions, make_ortho
from featuredb.simworld.town.scene import Scene
from featuredb.simworld.town.town import make_town
from featuredb.simworld.world import WorldOptions, town_of

SCAN_FILE, ORTHO_FILE = "scan.laz", "ortho.tif"
OTHER_SCAN_FILE, OTHER_ORTHO_FILE = "other_town_scan.laz", "other_town_ortho.tif"
_OTHER_TOWN = 2000  # added to the seed: neither this town nor that of the negative photos


def write_lidar(
    folder: Path,
    world: WorldOptions,
    note: Callable[[str], None] = lambda name: None,
    *,
    scan: AirborneScanOptions | None = None,
    ortho: OrthoOptions | None = None,
) -> None:
    """Write scan and ortho image, each of a day of its own, of the world's town and of another one in its
    place, to which nothing registers.

    Args:
        note: gets each file's name before it is made.

    Raises:
        MissingExtraError: the packages of the extra `lidar` are not installed.
        OSError: the folder cannot be written.
    """
    require("lidar", "A scan with an ortho image", "laspy", "lazrs", "rasterio")
    from featuredb.lidar.formats.geotiff import write_geotiff
    from featuredb.simworld.laser.scan_file import write_scan

    Path(folder).mkdir(parents=True, exist_ok=True)
    for scene, scan_name, ortho_name in (
        (town_of(world), SCAN_FILE, ORTHO_FILE),
        (other_town_here(world), OTHER_SCAN_FILE, OTHER_ORTHO_FILE),
    ):
        note(scan_name)
        write_scan(folder / scan_name, scan_town(scene, scan or AirborneScanOptions()))
        note(ortho_name)
        image = make_ortho(scene, ortho or OrthoOptions())
        write_geotiff(
            folder / ortho_name,
            image.rgb,
            epsg=image.epsg,
            west=image.west,
            north=image.north,
            pixel_m=image.pixel_m,
        )


def other_town_here(options: WorldOptions) -> Scene:
    """A town of another seed at the very place of the world's town."""
    return make_town(options.seed + _OTHER_TOWN, name="other town, same place", size_m=options.town_size_m)
