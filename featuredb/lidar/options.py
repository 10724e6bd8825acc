"""What can be chosen when a scan is added."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

from featuredb.lidar.outliers import OutlierOptions

_FORMAT = 1  # raised when the same files and options give other rows


@dataclass(frozen=True, slots=True, kw_only=True)
class AddOptions:
    """How a scan is read, cleaned and ordered.

    Attributes:
        crs: CRS in place of the files' own: EPSG code, WKT or PROJ string; None to take theirs.
        height_unit: unit of Z in place of the CRS's: "m", "ft" or "us-ft".
        height_datum: datum of the heights in place of the CRS's, see featuredb.geo.datum.
        epsg: UTM zone to store in; None for that of the first file's centre.
        outliers: outlier removal, or None for none.
        intensity_low_percent, intensity_high_percent: raw intensities that become 0 and 255.
        block_points: most points that are held at a time, without their surroundings.
        chunk_points: points that are read at a time.
    """

    crs: str | None = None
    height_unit: str | None = None
    height_datum: str | None = None
    epsg: int | None = None
    outliers: OutlierOptions | None = field(default_factory=OutlierOptions)
    # Specular glints and the darkest returns are a few per thousand to a percent of airborne scans, and
    # spread over most of the raw range; one percent at each end leaves the contrast to the rest.
    intensity_low_percent: float = 1.0
    intensity_high_percent: float = 99.0
    # About 400 bytes per point at the peak (neighbour search): a million are 0.4 GB.
    block_points: int = 1_000_000
    chunk_points: int = 500_000

    def scan_id(self, sha256: Sequence[str], ortho: Sequence[str] = ()) -> str:
        """Id of the scan that these files make with these options; the order of files does not count.

        Args:
            sha256: digest of each file.
            ortho: what names the ortho image that colours it, if any.
        """
        chosen = asdict(self)
        for name in ("block_points", "chunk_points"):  # do not change the result
            chosen.pop(name)
        text = json.dumps([_FORMAT, sorted(sha256), list(ortho), chosen], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]
