"""A scan from files into the database, in bounded memory: sort by tile, clean tile by tile, publish.

Everything before the last step happens in a work folder. A job that was killed goes on there: what is
finished is not done again. Files that are wrong in any way are found in the first step, which leaves nothing
behind.
"""

import hashlib
import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from featuredb.atomic import atomic_file, file_sha256, user_cache
from featuredb.errors import ConflictError, GeodesyError, ScanError
from featuredb.geo.crs.scan import ScanCrs, scan_crs
from featuredb.geo.crs.utm_transform import UtmTransform, utm_transform
from featuredb.geometry.arrays import FloatArray
from featuredb.lidar.clean import OutlierOptions, clean_block, finest_level
from featuredb.lidar.formats.las import ScanFile, open_scan_file, read_points
from featuredb.lidar.formats.ortho_image import OrthoImage, is_raster, open_dsm, open_ortho, read_dsm
from featuredb.lidar.ortho import LAID, check_overlap
from featuredb.lidar.spill import BlockPlan, Spill, Staged, stretch_of
from featuredb.store import Database
from featuredb.store.encode import Row
from featuredb.store.scans import ScanSummary, commit_scan, find_scan, list_scans

logger = logging.getLogger(__name__)

_LARGEST_8_BIT = 255

# Spilled and finished points take 36 and 55 bytes, and both lie here at the end.
_BYTES_PER_POINT = 100
_OF_CRS = ("horizontal_unit", "height_datum", "height_unit", "height_unit_m", "height_unit_reason")
_PLAN = "spill.json"  # in a work folder: the first pass is done
# Of Earth's surface, from Challenger Deep to Everest with its ellipsoidal heights.
_DEEPEST_M, _HIGHEST_M = -11_000.0, 9_000.0
_FORMAT = 1  # of scans: raised when the same files and options give other rows


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


@contextmanager
def work_folder(database: Database, work: Path | None, name: str, points: int) -> Iterator[Path]:
    """The folder of one job, locked; it stays when the job fails with a plan of blocks to go on from.

    Args:
        work: where jobs have their folders; by default `_work` in a local database, or a cache folder.
        name: of the job.
        points: how many it has to hold.

    Raises:
        ConflictError: another process works on the same job.
        ScanError: the folder cannot be made, or the disk is too small.
    """
    parent = work or (Path(database.url) / "_work" if "://" not in database.url else user_cache() / "lidar")
    path = parent / name
    try:
        path.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(path).free + sum(f.stat().st_size for f in path.rglob("*") if f.is_file())
    except OSError as error:
        raise ScanError(f"cannot use the work folder {path} ({error}); choose another by --work") from error
    lock, done = _lock(path), False
    try:
        if free < points * _BYTES_PER_POINT:
            raise ScanError(
                f"expected {points * _BYTES_PER_POINT / 1e9:.1f} GB free for the work folder {path}, found "
                f"{free / 1e9:.1f} GB; choose another by --work"
            )
        yield path
        done = True
    finally:
        if done or not (path / _PLAN).is_file():
            shutil.rmtree(path, ignore_errors=True)
            if work is None and parent.is_dir() and not any(parent.iterdir()):
                parent.rmdir()
        os.close(lock)


def _lock(path: Path) -> int:
    """A lock that the system gives up when the process ends, however it ends."""
    import fcntl

    lock = os.open(path / "lock", os.O_CREAT | os.O_RDWR)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(lock)
        raise ConflictError(f"another process is adding the same scan, in {path}; wait for it") from error
    return lock


@dataclass(frozen=True, slots=True, kw_only=True)
class AddResult:
    """A scan as it is in the database now; `created` is False if it was there already."""

    created: bool
    scan: ScanSummary


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanInput:
    """One file of a scan, its CRS, and the way to UTM."""

    file: ScanFile
    crs: ScanCrs
    to_utm: UtmTransform

    def corners(self) -> FloatArray:
        """UTM coordinates (8, 3) of the corners of the file's box, metres."""
        axes = np.stack([self.file.low, self.file.high], axis=1)
        return self.to_utm.apply(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3))


OnProgress = Callable[[str, int, int], None]
"""Told the step ("read", "clean", "write"), and how many points of how many are done in it."""


def add_scan(
    database: Database,
    files: Sequence[Path],
    options: AddOptions | None = None,
    *,
    name: str = "",
    licence: str = "",
    source: str = "",
    ortho: Path | None = None,
    ortho_crs: str | None = None,
    work: Path | None = None,
    on_progress: OnProgress = lambda step, done, total: None,
) -> AddResult:
    """Add the scan that one or several LAS, LAZ or COPC files, or rasters of heights, make.

    The database is made where there is none.

    The same files with the same options are the same scan: adding it twice changes nothing.

    Args:
        files: the files of one survey; they may differ in CRS, but not in the datum of their heights.
        name: for listings; "" for the first file's name. licence, source: for those who use it later.
        ortho: image that GDAL reads, which colours what is seen from above. ortho_crs: in place of its own.
        work: where unfinished work is kept; by default `_work` in a local database.

    Raises:
        ScanFileError: a file is not LAS, empty, truncated or broken; nothing is left behind.
        GeodesyError: a CRS is missing, broken or wrong.
        ScanError: the files do not fit each other, nothing is left of them, or the image lies elsewhere.
        StoreError: the database cannot be written.
        MissingExtraError: the packages of the extra `lidar` are not installed.
    """
    options, opened = options or AddOptions(), _open_all(files)
    image = None if ortho is None else open_ortho(ortho, ortho_crs)
    # What tells the image and its use from others: name apart, so that a copy is the same.
    look = [] if ortho is None else [file_sha256(ortho), ortho_crs or "", json.dumps(LAID, sort_keys=True)]
    scan_id = options.scan_id([file.sha256 for file in opened], look)
    for scan in list_scans(database):
        if scan.scan_id == scan_id:
            return AddResult(created=False, scan=scan)
    inputs = _place_all(opened, options)
    if image is not None:
        check_overlap(image, np.concatenate([item.corners() for item in inputs]), inputs[0].to_utm.epsg)
    with work_folder(database, work, f"lidar-{scan_id}", sum(f.points for f in opened)) as folder:
        plan = _read_all(folder, inputs, options, on_progress)
        staged = _clean_all(folder, plan, options, image, inputs[0].to_utm.epsg, on_progress)
        row = _row(scan_id, inputs, plan, staged, options)
        row |= {"name": name or inputs[0].file.path.name, "source": source, "licence": licence}
        if image is not None:
            shown = staged.shown()
            row |= {"colour": "ortho" if shown else row["colour"], "ortho": json.dumps(look)}
            row["notes"].append(f"the ortho image colours {shown / row['points']:.1%} of the points")
        Database.create(database.url, storage_options=database.storage_options)
        created, _ = commit_scan(
            database,
            row,
            staged.groups(),
            lambda points: on_progress("write", points, row["points"]),
        )
    return AddResult(created=created, scan=find_scan(database, scan_id))


def _open_all(files: Sequence[Path]) -> list[ScanFile]:
    if not files:
        raise ScanError("expected at least one LAS, LAZ or COPC file or raster of heights, found none")
    opened: dict[str, ScanFile] = {}
    for path in files:
        path = Path(path)
        file = open_dsm(path) if is_raster(path) else open_scan_file(path)
        if file.sha256 in opened:
            logger.warning("%s is the same file as %s and counts once", path, opened[file.sha256].path)
        opened.setdefault(file.sha256, file)
    return list(opened.values())


def _place_all(files: Sequence[ScanFile], options: AddOptions) -> list[ScanInput]:
    """The CRS of each file and its way to the zone that is wanted, or that of the first."""
    inputs: list[ScanInput] = []
    epsg = options.epsg
    for file in files:
        # The header says which of the two counts; where that one is missing, it is the other.
        wkt = file.wkt if file.wkt_counts or not file.geo_keys else None
        try:
            crs = scan_crs(
                wkt=wkt,
                geo_keys=None if wkt else file.geo_keys,
                override=options.crs,
                height_unit=options.height_unit,
                height_datum=options.height_datum,
            )
            to_utm = utm_transform(crs, file.low, file.high, epsg)
            inputs.append(ScanInput(file=file, crs=crs, to_utm=to_utm))
            _check_heights(inputs[-1])
        except GeodesyError as error:
            raise GeodesyError(f"{file.path}: {error}") from error
        epsg = to_utm.epsg
        if crs.height_datum != inputs[0].crs.height_datum:
            raise ScanError(
                f"expected files with heights of one datum, found {inputs[0].crs.height_datum} in "
                f"{inputs[0].file.path} and {crs.height_datum} in {file.path}; add them as two scans"
            )
    return inputs


def _check_heights(item: ScanInput) -> None:
    """Refuse heights of which none is one of Earth's surface; single ones may be noise."""
    heights = item.corners()[:, 2]
    low, high = float(heights.min()), float(heights.max())
    if low > _HIGHEST_M or high < _DEEPEST_M:
        raise GeodesyError(
            f"expected heights between {_DEEPEST_M:.0f} and {_HIGHEST_M:.0f} m, found {low:.0f} to "
            f"{high:.0f} m by the unit {item.crs.height_unit} ({item.crs.height_unit_reason}); state "
            "theirs by --height-unit, that of a raster in centimetres e.g. by gdal_edit.py -scale 0.01"
        )


def _read_all(
    folder: Path, inputs: Sequence[ScanInput], options: AddOptions, on_progress: OnProgress
) -> BlockPlan:
    """Read all files into blocks, or find that this was done."""
    if (folder / _PLAN).is_file():
        return TypeAdapter(BlockPlan).validate_json((folder / _PLAN).read_bytes())
    total = sum(item.file.points for item in inputs)
    spill = Spill(folder / "spill")
    spill.clear()
    for number, item in enumerate(inputs):
        spill.add_file(
            number,
            (read_dsm if is_raster(item.file.path) else read_points)(item.file.path, options.chunk_points),
            item.to_utm.apply,
            lambda read: on_progress("read", read, total),
        )
    if spill.read == spill.noise + spill.withheld:
        raise ScanError(
            f"expected points to keep, found none in {', '.join(str(item.file.path) for item in inputs)}: "
            f"{spill.noise} are classified as noise and {spill.withheld} are withheld"
        )
    spacing_m = spill.spacing_m()
    plan = BlockPlan(
        read=spill.read,
        noise=spill.noise,
        withheld=spill.withheld,
        spacing_m=spacing_m,
        finest_level=finest_level(spacing_m),
        stretch=stretch_of(spill.intensity, options.intensity_low_percent, options.intensity_high_percent),
        # For the range that a file's colours use, none where all are black: many leave the fields so.
        colour_bits=tuple(0 if top <= 0 else 8 if top <= _LARGEST_8_BIT else 16 for top in spill.largest_rgb),
        blocks=tuple(spill.split(options.block_points)),
    )
    with atomic_file(folder / _PLAN) as temporary:
        temporary.write_text(json.dumps(asdict(plan)))
    return plan


def _clean_all(
    folder: Path,
    plan: BlockPlan,
    options: AddOptions,
    image: OrthoImage | None,
    epsg: int,
    on_progress: OnProgress,
) -> Staged:
    """Clean, stretch and order block by block; finished ones are left alone."""
    spill, staged = Spill(folder / "spill"), Staged(folder / "staged", plan)
    total, done = sum(block.points for block in plan.blocks), 0
    for block in plan.blocks:
        if not staged.has(block):
            staged.put(block, *clean_block(spill, plan, block, options.outliers, image, epsg))
        done += block.points
        on_progress("clean", done, total)
    return staged


def _units(crs: ScanCrs) -> str:
    return f"X, Y in {crs.horizontal_unit}, Z in {crs.height_unit} ({crs.height_unit_reason})"


def _row(
    scan_id: str,
    inputs: Sequence[ScanInput],
    plan: BlockPlan,
    staged: Staged,
    options: AddOptions,
) -> Row:
    """The scan's row in `lidar`, but for what people say about it."""
    crs = inputs[0].crs
    notes = [note for item in inputs for note in (*item.crs.notes, *item.to_utm.notes)]
    units = {item.file.path.name: _units(item.crs) for item in inputs}
    if len(set(units.values())) > 1:
        crs = replace(crs, height_unit_reason=f"{crs.height_unit_reason}, in the first file, see the note")
        told = "; ".join(f"{name} has {unit}" for name, unit in units.items())
        notes.append(f"files of several units, all stored in metres: {told}")
    return {
        "scan_id": scan_id,
        "files": [
            {
                "name": item.file.path.name,
                "sha256": item.file.sha256,
                "size_bytes": item.file.size_bytes,
                "points": item.file.points,
                "crs": item.crs.name,
                "transformation": item.to_utm.description,
                "transformation_accuracy_m": item.to_utm.accuracy_m,
            }
            for item in inputs
        ],
        "epsg": inputs[0].to_utm.epsg,
        **staged.totals(),
        "tiles": sorted({block.tile for block in plan.blocks}),
        "points_in_files": plan.read,
        "dropped_noise": plan.noise,
        "dropped_withheld": plan.withheld,
        "spacing_m": plan.spacing_m,
        "colour": "file" if any(plan.colour_bits) else "",
        "ortho": "",
        "has_intensity": plan.stretch is not None,
        "intensity_low": None if plan.stretch is None else plan.stretch.low,
        "intensity_high": None if plan.stretch is None else plan.stretch.high,
        "crs_source": crs.source,
        "vertical_crs": crs.vertical_name,
        **{name: getattr(crs, name) for name in _OF_CRS},
        "notes": list(dict.fromkeys(notes)),
        "options": json.dumps(asdict(options), sort_keys=True),
    }
