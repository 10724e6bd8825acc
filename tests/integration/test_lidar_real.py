"""Real scans: counts, systems, units and places against laspy's header and pyproj, used directly."""

from pathlib import Path

import laspy
import numpy as np
import pytest
from pyproj import CRS, Transformer

from featuredb.errors import GeodesyError
from featuredb.lidar.add import AddOptions, add_scan
from featuredb.lidar.load import load_cloud, scan_frame
from featuredb.store import Database
from featuredb.store.verify import verify

# CRS by its publisher, metres per unit of height, UTM zone, latitude and longitude to 0.02 degrees.
FILES = {
    "lidar/autzen_trim.laz": ("EPSG:2994", 0.3048, 32610, (44.05, -123.07)),  # stadium of Eugene, Oregon
    "autzen/stadium.laz": ("EPSG:2994", 0.3048, 32610, (44.0583, -123.0685)),
    "lidar/Topography.laz": ("EPSG:2949", 1.0, 32619, (47.61, -70.92)),
    "lidar/bcts_1.laz": ("EPSG:3005", 1.0, 32609, (50.67, -127.63)),
    "brighton/model.laz": ("EPSG:32615", 1.0, 32615, (46.842, -91.994)),
    "lidar/lone-star.copc.laz": ("EPSG:32612", 1.0, 32612, (44.4176, -110.8069)),  # a geyser of Yellowstone
}
OFTEN = (
    "lidar/autzen_trim.laz",
    "lidar/Topography.laz",
    "lidar/lone-star.copc.laz",
)  # feet; metres; COPC, no CRS


@pytest.mark.real_data
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in OFTEN else pytest.mark.evaluation) for name in FILES],
)
def test_real_scans(shared_data: Path, tmp_path: Path, name: str) -> None:
    code, height_unit_m, epsg, (latitude, longitude) = FILES[name]
    path = shared_data / name
    database = Database(str(tmp_path / "scans.db"))
    stated = AddOptions(crs=code) if "lone-star" in name else AddOptions()
    if stated.crs:
        with pytest.raises(GeodesyError, match=r"4,945 km from the Earth's centre.*--crs"):
            add_scan(database, [path])
        assert not Path(database.url).exists()
    scan = add_scan(database, [path], stated).scan
    with laspy.open(path) as reader:
        las = reader.read()
    assert scan.points_in_files == len(las)
    assert scan.row["dropped_noise"] == int(np.isin(las.classification, (7, 18)).sum())
    dropped = scan.row["dropped_noise"] + scan.row["dropped_withheld"] + scan.row["dropped_outliers"]
    assert scan.points == len(las) - dropped
    assert scan.row["dropped_outliers"] < 1e-3 * len(las)
    assert scan.epsg == epsg
    assert scan.height_datum == "unknown"
    assert scan.row["height_unit_m"] == pytest.approx(height_unit_m, rel=1e-12)

    # Corners of the file by its publisher's CRS; datum shifts that pyproj may choose otherwise are up to 2 m.
    to_utm = Transformer.from_crs(CRS.from_user_input(code), epsg, always_xy=True)
    east, north = to_utm.transform(np.asarray(las.x), np.asarray(las.y))
    box = scan.box
    for low, high, values in (
        (box.min_easting, box.max_easting, east),
        (box.min_northing, box.max_northing, north),
    ):
        assert abs(low - values.min()) < 4.0
        assert abs(high - values.max()) < 4.0
    z = np.asarray(las.z) * height_unit_m
    assert z.min() - 1e-6 <= box.min_height <= np.quantile(z, 0.001) + 0.01
    assert np.quantile(z, 0.999) - 0.01 <= box.max_height <= z.max() + 1e-6
    center = Transformer.from_crs(epsg, 4326, always_xy=True).transform(np.mean(east), np.mean(north))
    assert center == pytest.approx((longitude, latitude), abs=0.02)

    colours = "red" in set(las.point_format.dimension_names)
    assert scan.colour == ("file" if colours else "")
    assert scan.has_intensity == (np.ptp(np.asarray(las.intensity)) > 0)
    expected = {
        1 if c == 0 else int(c): int(n)
        for c, n in zip(*np.unique(las.classification, return_counts=True), strict=True)
    }
    assert scan.classes.keys() == expected.keys()
    for label, points in scan.classes.items():
        assert 0 <= expected[label] - points <= scan.row["dropped_outliers"]

    cloud = load_cloud(database, scan_frame(scan))
    assert len(cloud) == scan.points
    assert (cloud.rgb is not None) == colours
    if cloud.rgb is not None:
        raw = np.stack([np.asarray(las[c], np.float64) for c in ("red", "green", "blue")], axis=1)
        bits_8 = raw if raw.max() <= 255 else np.floor(raw / 256.0)  # brighton's are 8-bit in 16-bit fields
        assert np.abs(cloud.rgb.mean(axis=0) - bits_8.mean(axis=0)).max() < 0.05
    assert verify(database).ok
