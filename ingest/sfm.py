"""Stage: structure from motion of matched photos; each connected component becomes a model."""

import hashlib
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from featuredb.geometry.camera import Camera
from ingest.colmap_adjust import AdjustOptions, adjust_models
from ingest.colmap_bridge import Model, SfmPhoto, TwoView, read_models, run_incremental, write_database
from ingest.executor import Progress, no_progress
from ingest.workspace import atomic_folder

PriorUse = Literal["none", "bundle"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SfmOptions:
    """How photos are reconstructed.

    Attributes:
        camera_model: COLMAP's model of every camera whose EXIF gives no better one.
        position_priors: "bundle" puts GPS positions into the bundle adjustment, "none" keeps them for
            the placement afterwards.
        refine_focal: focal lengths of EXIF are a start; kept as they are otherwise.
        min_model_photos: smaller models are dropped; three photos are the least that a placement by
            positions needs.
        min_inliers: verified matches of a pair that mapping may use.
        filter_max_error_px: observations with a larger reprojection error are dropped, at
            `error_reference_side_px`, growing with the image.
        error_reference_side_px: keypoints are located on images of about this size.
        keep_two_view_tracks: points seen by two photos only are triangulated too.
        seed: of all random choices.
        threads: of bundle adjustment; one gives the same numbers in every run.
        adjust: the final adjustment of each model.
    """

    camera_model: str = "SIMPLE_RADIAL"
    position_priors: PriorUse = "none"
    refine_focal: bool = True
    min_model_photos: int = 3
    min_inliers: int = 20
    filter_max_error_px: float = 4.0
    error_reference_side_px: int = 1600
    keep_two_view_tracks: bool = True
    seed: int = 0
    threads: int = 1
    adjust: AdjustOptions = field(default_factory=AdjustOptions)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SfmTask:
    """All that structure from motion needs.

    Attributes:
        cameras: with whether the focal length is known from EXIF.
        photos: their keypoints, cameras and priors.
        geometries: two-view geometries of pairs of rows of `photos`.
    """

    cameras: tuple[tuple[Camera, bool], ...]
    photos: tuple[SfmPhoto, ...]
    geometries: Mapping[tuple[int, int], TwoView]

    def key(self, options: SfmOptions) -> str:
        """Digest (16 characters) of the content: equal keys give equal models."""
        content = hashlib.sha256(repr((self.cameras, options)).encode())
        for photo in self.photos:
            content.update(repr((photo.name, photo.camera_row)).encode())
            content.update(photo.keypoints.tobytes())
            if photo.prior_position is not None and photo.prior_covariance is not None:
                content.update(photo.prior_position.tobytes() + photo.prior_covariance.tobytes())
        for pair, view in sorted(self.geometries.items()):
            content.update(repr(pair).encode() + view.inliers.tobytes())
        return content.hexdigest()[:16]


def reconstruct(
    task: SfmTask, folder: Path, options: SfmOptions, progress: Progress = no_progress
) -> list[Model]:
    """Reconstruct, or read what an earlier run left in `folder`.

    Returns:
        Models with at least `min_model_photos` photos, largest first. A photo is in one model only.
    """
    if not folder.is_dir():
        with atomic_folder(folder) as temporary:
            _map(task, temporary, options, progress)
    progress("reconstruct", len(task.photos), len(task.photos))
    return disjoint(read_models(folder), options.min_model_photos)


def _map(task: SfmTask, folder: Path, options: SfmOptions, progress: Progress) -> None:
    if not task.geometries:
        return
    side = max(max(camera.width, camera.height) for camera, _ in task.cameras)
    registered = 2  # COLMAP tells of each photo after the first pair

    def on_photo() -> None:
        nonlocal registered
        registered = min(registered + 1, len(task.photos) - 1)
        progress("reconstruct", registered, len(task.photos))

    with tempfile.TemporaryDirectory(prefix="featuredb-sfm-") as scratch:
        database = Path(scratch) / "colmap.db"
        write_database(database, task.cameras, task.photos, task.geometries)
        run_incremental(database, Path(scratch), folder, mapping_settings(options, side), on_photo)
        # A SIFT keypoint is good to about half a pixel of the image that it was found on.
        scale_px = 0.5 * max(1.0, side / options.error_reference_side_px)
        adjust = replace(options.adjust, refine_focal=options.adjust.refine_focal and options.refine_focal)
        adjust_models(folder, database, task.photos, scale_px, adjust)


def mapping_settings(options: SfmOptions, side_px: int) -> dict[str, Any]:
    """COLMAP's settings; thresholds in pixels grow with the image, since keypoints' errors do."""
    zoom = max(1.0, side_px / options.error_reference_side_px)
    return {
        "random_seed": options.seed,
        "num_threads": options.threads,
        "extract_colors": False,
        "ba_refine_focal_length": options.refine_focal,
        "min_num_matches": options.min_inliers,
        "min_model_size": options.min_model_photos,
        "use_prior_position": options.position_priors == "bundle",
        "use_robust_loss_on_prior_position": options.position_priors == "bundle",
        "mapper.filter_max_reproj_error": options.filter_max_error_px * zoom,
        "mapper.init_max_error": 4.0 * zoom,
        "mapper.abs_pose_max_error": 8.0 * zoom,
        "triangulation.merge_max_reproj_error": options.filter_max_error_px * zoom,
        "triangulation.complete_max_reproj_error": options.filter_max_error_px * zoom,
        "triangulation.ignore_two_view_tracks": not options.keep_two_view_tracks,
    }


def disjoint(models: Sequence[Model], min_photos: int) -> list[Model]:
    """Large models first; a later model keeps out if it shares photos with an earlier one.

    COLMAP may grow a second model into photos of the first. Two maps with the same photos would agree
    with themselves; the smaller one says nothing that the larger does not.
    """
    chosen: list[Model] = []
    taken: set[int] = set()
    for model in models:
        rows = set(model.rows.tolist())
        if len(rows) >= min_photos and not rows & taken:
            chosen.append(model)
            taken |= rows
    return chosen
