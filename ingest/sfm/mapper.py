"""Stage: structure from motion of matched photos; each connected component becomes a model."""

import hashlib
import logging
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from featuredb.atomic import atomic_folder
from featuredb.errors import InvalidValueError
from featuredb.geometry.camera import SUPPORTED_MODELS, Camera
from ingest.colmap.adjust import AdjustOptions, Known, adjust_models
from ingest.colmap.bridge import Model, SfmPhoto, read_models, run_incremental, write_database
from ingest.sfm.extract import read_keypoints
from ingest.sfm.held_lens import better_supported, mostly_impossible
from ingest.sfm.links import keep_photos
from ingest.sfm.matching import read_two_view
from ingest.sfm.view_graph_focals import (
    calibrate_focals,
    map_globally,
    registered_with_usual_lens,
    start_from,
)

logger = logging.getLogger(__name__)

_VERSION = 3  # raised when the same task would give other models
_MANY_PHOTOS = 8  # of one lens: a film's keyframes, not a visitor's photos
_MOSTLY = 0.5  # of the photos; fewer with a lens that people have, and the start is to blame


@dataclass(frozen=True, slots=True, kw_only=True)
class SfmOptions:
    """How photos are reconstructed.

    Attributes:
        camera_model: COLMAP's model of every camera whose EXIF gives no better one.
        refine_focal: focal lengths of EXIF are a start; kept as they are otherwise.
        min_model_photos: smaller models are dropped; three photos are the least that a placement by
            positions needs.
        min_inliers: verified matches of a pair that mapping may use.
        focal_from_view_graph: where photos stay outside, start once more with focal lengths from the pairs
            for cameras that do not tell theirs, and keep what registers more.
        least_inlier_ratio: of a photo's matches with a model, that its pose is looked for with.
        filter_max_error_px: observations with a larger reprojection error are dropped, at
            `error_reference_side_px`, growing with the image.
        error_reference_side_px: keypoints are located on images of about this size.
        seed: of all random choices.
        threads: of bundle adjustment; one gives the same numbers in every run.
        adjust: the final adjustment of each model.
    """

    camera_model: str = "SIMPLE_RADIAL"
    refine_focal: bool = True
    focal_from_view_graph: bool = True
    min_model_photos: int = 3
    min_inliers: int = 20
    least_inlier_ratio: float = 0.6
    filter_max_error_px: float = 4.0
    error_reference_side_px: int = 1600
    seed: int = 0
    threads: int = 1
    adjust: AdjustOptions = field(default_factory=AdjustOptions)

    def __post_init__(self) -> None:
        if self.camera_model not in SUPPORTED_MODELS:
            raise InvalidValueError(
                f"camera model: expected one of {', '.join(SUPPORTED_MODELS)}, found {self.camera_model!r}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class SfmView:
    """A photo of a reconstruction: what travels to a worker, which reads the rest from files.

    Attributes:
        name: unique.
        camera_row: row of the cameras.
        features: its features file, whose name is a digest of what it was made of.
        prior_position: camera centre in a local metric frame, or None.
        prior_sigma_m: standard deviations of the position.
    """

    name: str
    camera_row: int
    features: Path
    prior_position: tuple[float, float, float] | None = None
    prior_sigma_m: tuple[float, float, float] | None = None

    def photo(self) -> SfmPhoto:
        """With its keypoints."""
        return SfmPhoto(
            name=self.name,
            camera_row=self.camera_row,
            keypoints=read_keypoints(self.features),
            prior_position=self.prior_position,
            prior_sigma_m=self.prior_sigma_m,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SfmTask:
    """All that structure from motion of some photos needs; travels to a worker.

    Attributes:
        cameras: with whether the focal length is known from EXIF.
        views: the photos.
        matches: files of the verified pairs of rows of `views`, sorted.
        options: how they are reconstructed.
    """

    cameras: tuple[tuple[Camera, bool], ...]
    views: tuple[SfmView, ...]
    matches: tuple[tuple[int, int, Path], ...]
    options: SfmOptions

    def __str__(self) -> str:
        return f"{len(self.views)} photos around {self.views[0].name}"

    @property
    def side_px(self) -> int:
        """Longest side of all photos."""
        return max(max(camera.width, camera.height) for camera, _ in self.cameras)

    @property
    def shares_unknown_lenses(self) -> bool:
        """Whether lenses that nobody knows took many photos each, as those of films do."""
        unknown = {row for row, (_, known) in enumerate(self.cameras) if not known}
        photos = sum(view.camera_row in unknown for view in self.views)
        return bool(unknown) and photos >= _MANY_PHOTOS * len(unknown)

    def exif_px(self) -> list[float | None]:
        """Focal length of EXIF by row of the photo."""
        told = [camera.focal_px if known else None for camera, known in self.cameras]
        return [told[view.camera_row] for view in self.views]

    def key(self) -> str:
        """Digest (24 characters) of the content: equal keys give equal models."""
        content = hashlib.sha256(repr((_VERSION, self.cameras, self.options)).encode())
        for view in self.views:
            made_of = (view.features.parent.name, view.features.name)
            content.update(repr((view.name, view.camera_row, made_of)).encode())
            content.update(repr((view.prior_position, view.prior_sigma_m)).encode())
        for i, j, file in self.matches:
            content.update(repr((i, j, file.parent.parent.name, file.name)).encode())
        return content.hexdigest()[:24]

    def write_database(self, path: Path) -> tuple[SfmPhoto, ...]:
        """COLMAP's database of the photos and their pairs; the photos as they were read."""
        photos = tuple(view.photo() for view in self.views)
        geometries = {(i, j): read_two_view(file) for i, j, file in self.matches}
        write_database(path, self.cameras, photos, geometries)
        return photos

    def known(self, photos: tuple[SfmPhoto, ...]) -> Known:
        """What the final adjustment may rest on besides the matches."""
        focals = {row + 1: camera.focal_px for row, (camera, known) in enumerate(self.cameras) if known}
        return Known(photos=photos, focal_px=focals)


def reconstruct(task: SfmTask, folder: Path) -> None:
    """Reconstruct into `folder`, one numbered COLMAP model each connected part; nothing if it is there."""
    if folder.is_dir():
        return
    with atomic_folder(folder) as output, tempfile.TemporaryDirectory(prefix="featuredb-sfm-") as scratch:
        if not task.matches:
            return
        options = task.options
        database = Path(scratch) / "colmap.db"
        photos = task.write_database(database)
        _map(task, database, Path(scratch), output)
        astray = options.refine_focal and mostly_impossible(read_models(output), task.exif_px())
        adjust_models(output, database, task.known(photos), loss_scale_px(task), adjust_options(options))
        if astray:
            _hold_lens(task, Path(scratch) / "held", output)


def _hold_lens(task: SfmTask, scratch: Path, output: Path) -> None:
    """Map again with the lens held at EXIF's; in place of what is in `output` if it counts."""
    again = scratch / "models"
    again.mkdir(parents=True)
    database = scratch / "colmap.db"  # the first one has got the first attempt's lenses
    photos = task.write_database(database)
    _map(replace(task, options=replace(task.options, refine_focal=False)), database, scratch, again)
    adjust_models(again, database, task.known(photos), loss_scale_px(task), adjust_options(task.options))
    held, free = (disjoint(read_models(f), task.options.min_model_photos) for f in (again, output))
    if not held or mostly_impossible(held, task.exif_px()):
        return
    limit_px = mapping_settings(task.options, task.side_px)["mapper.filter_max_reproj_error"]
    keypoints = [photo.keypoints for photo in photos]
    if better_supported(held, free, keypoints, limit_px, task.options.adjust.dilution):
        logger.info("%s: with the lens held", task)
        _take(again, output)


def _map(task: SfmTask, database: Path, scratch: Path, output: Path) -> None:
    """Incremental mapping; again from another start where the first one may be why photos stay outside."""
    options = task.options
    settings = mapping_settings(options, task.side_px)
    registered = len(run_incremental(database, scratch, output, settings))
    if options.focal_from_view_graph and registered < len(task.views):
        focals = calibrate_focals(database, scratch, seed=options.seed)
        if focals:
            again = scratch / "again"
            again.mkdir()
            start = scratch / "start.db"
            shutil.copyfile(database, start)
            start_from(start, focals)
            more = len(run_incremental(start, scratch, again, settings))
            logger.info("%s: %d registered, %d with focal lengths from the pairs", task, registered, more)
            if more > registered:
                _take(again, output)
    if options.refine_focal and task.shares_unknown_lenses:
        _map_from_all(task, database, scratch, output)


def _map_from_all(task: SfmTask, database: Path, scratch: Path, output: Path) -> None:
    """Global mapping, where incremental mapping found no usual lens for most photos and this finds more."""
    known = [row for row, view in enumerate(task.views) if task.cameras[view.camera_row][1]]
    before = registered_with_usual_lens(output, known)
    if before >= _MOSTLY * len(task.views):
        return
    at_once = scratch / "at once"
    at_once.mkdir()
    options = task.options
    map_globally(
        database,
        scratch,
        at_once,
        min_photos=options.min_model_photos,
        min_inliers=options.min_inliers,
        seed=options.seed,
    )
    after = registered_with_usual_lens(at_once, known)
    logger.info("%s: %d with a usual lens, %d by global mapping", task, before, after)
    if after > before:
        _take(at_once, output)


def _take(models: Path, output: Path) -> None:
    """These model folders instead of those in `output`."""
    for folder in output.iterdir():
        shutil.rmtree(folder)
    for folder in models.iterdir():
        shutil.move(folder, output)


def loss_scale_px(task: SfmTask) -> float:
    """A SIFT keypoint is good to about half a pixel of the image that it was found on."""
    return 0.5 * max(1.0, task.side_px / task.options.error_reference_side_px)


def adjust_options(options: SfmOptions) -> AdjustOptions:
    """Of the final adjustment: the focal length is free there only if it is anywhere."""
    return replace(options.adjust, refine_focal=options.adjust.refine_focal and options.refine_focal)


def mapping_settings(options: SfmOptions, side_px: int) -> dict[str, Any]:
    """COLMAP's settings; thresholds in pixels grow with the image, since keypoints' errors do."""
    zoom = max(1.0, side_px / options.error_reference_side_px)
    return {
        "random_seed": options.seed,
        "num_threads": options.threads,
        "extract_colors": False,
        "ba_refine_focal_length": options.refine_focal,
        # By default everything is adjusted at a tenth more photos or points, and to the last digit; the final
        # adjustment does that.
        "ba_global_frames_ratio": 1.2,
        "ba_global_points_ratio": 1.2,
        "ba_global_function_tolerance": 1e-5,
        "ba_local_function_tolerance": 1e-4,
        "min_num_matches": options.min_inliers,
        "min_model_size": options.min_model_photos,
        # Bounds the trials of photos that see few points (decision 3): those of a generalised relative pose,
        # of six matches, grow with its sixth power. From three points a photo of which only a quarter of the
        # matches is right is still found nine times in ten.
        "mapper.abs_pose_min_inlier_ratio": options.least_inlier_ratio,
        "mapper.filter_max_reproj_error": options.filter_max_error_px * zoom,
        "mapper.init_max_error": 4.0 * zoom,
        "mapper.abs_pose_max_error": 8.0 * zoom,
        "triangulation.merge_max_reproj_error": options.filter_max_error_px * zoom,
        "triangulation.complete_max_reproj_error": options.filter_max_error_px * zoom,
        "triangulation.ignore_two_view_tracks": False,
    }


def disjoint(models: Sequence[Model], min_photos: int) -> list[Model]:
    """Large models first; a later model loses the photos that it shares with earlier ones.

    COLMAP may grow a second model into photos of the first. Two maps with the same photos would agree
    with themselves. What is left of the smaller one counts if it still hangs together.
    """
    chosen: list[Model] = []
    taken: set[int] = set()
    for model in models:
        rest = keep_photos(model, set(model.rows.tolist()) - taken, least=min_photos)
        if rest is not None:
            chosen.append(rest)
            taken |= set(rest.rows.tolist())
    return chosen
