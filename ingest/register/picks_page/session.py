"""What the page of picks works on: one map, its photos, a scan; picks to a pose, a verdict, a place."""

import csv
from collections.abc import Sequence
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, FiniteFloat

from featuredb.errors import FeatureDbError, InvalidValueError
from featuredb.features.decode import INGEST_LIMITS, decode_rgb
from featuredb.features.shrink import shrunk
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.lidar.load import load_cloud, scan_frame
from featuredb.lidar.picture import ground_of
from featuredb.maps.feature_map import MapImage
from featuredb.maps.unplaced_map import AnyMap, UnplacedMap
from featuredb.render.cloud import PointCloud
from featuredb.store import Database
from ingest.anchoring import Anchoring, AnchorRequest, anchor
from ingest.register.anchor.files import PhotoFiles, find_photos
from ingest.register.anchor.page import edge_layer, jpeg, png, scan_view
from ingest.register.anchor.start.first_place import StartFiles, scans_of_one_zone
from ingest.register.anchor.start.pick_fit import PickFit, fit_picks
from ingest.register.anchor.start.picks import focal_sigma_rel, least_picks, prior_of_picks
from ingest.register.structure.surface_fit import median_m

_PHOTO_PX = 4096
_GROUND_PX, _GROUND_GAP_PX, _GROUND_EMPTY = 4000, 5, 24
PICKS_FILE = "picks.csv"


class PickedSpot(BaseModel):
    """One pick of the page: full-size pixel of the photo, and a place in the picture of the ground."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    x: FiniteFloat
    y: FiniteFloat
    ground_x: FiniteFloat
    ground_y: FiniteFloat


class PickSession:
    """One map on one scan. Methods may be called from several threads."""

    def __init__(self, database: Database, request: AnchorRequest, loaded: AnyMap) -> None:
        self.database, self.request, self.map = database, request, loaded
        self.files: PhotoFiles = find_photos(loaded, request.photos)
        scans = scans_of_one_zone(database, request.scan_ids)
        self.scan_ids = tuple(scan.scan_id for scan in scans)
        self.epsg = scans[0].epsg
        self.cloud: PointCloud = load_cloud(database, scan_frame(scans[0]), scan_ids=self.scan_ids)
        finest_m = max(0.7 * min(scan.spacing_m for scan in scans), 0.02)
        self.ground = ground_of(self.cloud, finest_m, _GROUND_PX, _GROUND_GAP_PX, _GROUND_EMPTY)
        self.out = request.out or Path(f"anchor-{loaded.map_id}")
        self._work, self._fits = Lock(), dict[int, PickFit]()
        self._proposed: Anchoring | None = None

    def state(self) -> dict[str, Any]:
        """What the page shows first."""
        height, width = self.ground.height.shape
        seen_by = self.map.image_rows(self.map.observations.image_id)
        counts = np.bincount(seen_by, minlength=len(self.map.images)).tolist()
        return {
            "map": {
                "id": self.map.map_id,
                "name": self.map.name,
                "placed": not isinstance(self.map, UnplacedMap),
                "reason": self.map.no_place.reason if isinstance(self.map, UnplacedMap) else "",
            },
            "ground": {"width": width, "height": height, "pixel_m": self.ground.pixel_m},
            "photos": [
                {
                    "id": image.image_id,
                    "name": image.name,
                    "width": self.map.cameras[image.camera_id].width,
                    "height": self.map.cameras[image.camera_id].height,
                    "points": count,
                    "least": least_picks(focal_sigma_rel(self.map, image)),
                }
                for image, count in zip(self.map.images, counts, strict=True)
                if image.image_id in self.files.paths
            ],
        }

    def image(self, image_id: int) -> MapImage:
        """A photo of the map that is there.

        Raises:
            InvalidValueError: there is none of that id.
        """
        for image in self.map.images:
            if image.image_id == image_id and image_id in self.files.paths:
                return image
        raise InvalidValueError(f"the map has no photo {image_id} in {self.files.folder}")

    def photo_jpeg(self, image_id: int) -> bytes:
        rgb = decode_rgb(self.files.path(self.image(image_id)), INGEST_LIMITS)
        return jpeg(shrunk(rgb, _PHOTO_PX))

    def ground_png(self) -> bytes:
        return png(self.ground.rgb)

    def spots(self, spots: Sequence[PickedSpot]) -> tuple[FloatArray, FloatArray]:
        """Pixels (n, 2), and points (n, 3) in the cloud's frame.

        Raises:
            InvalidValueError: a spot has no scan.
        """
        pixels = np.array([[s.x, s.y] for s in spots]).reshape(-1, 2)
        return pixels, np.array([self.ground.spot(s.ground_x, s.ground_y) for s in spots]).reshape(-1, 3)

    def solve(self, image_id: int, spots: Sequence[PickedSpot]) -> dict[str, Any]:
        """The pose by the picks so far, the residual of each, and what is missing or wrong."""
        image = self.image(image_id)
        camera, focal_rel = self.map.cameras[image.camera_id], focal_sigma_rel(self.map, image)
        pixels, points = self.spots(spots)
        self._fits.pop(image_id, None)
        least = least_picks(focal_rel)
        fit = fit_picks(pixels, points, camera, focal_rel) if len(spots) >= least else None
        if fit is None:
            few = f"{len(spots)} of at least {least} picks" if len(spots) < least else ""
            message = few or "no pose explains these picks"
            return {"ready": False, "pose": False, "message": message, "picks": []}
        self._fits[image_id] = fit
        found: dict[str, Any] = {
            "pose": True,
            "picks": [
                {
                    "residual_px": float(fit.distances_px[i]),
                    "at": (pixels[i] - fit.residuals_px[i]).tolist(),
                    "sigmas": None if i in fit.wrong else float(fit.normalised[i]),
                    "wrong": i in fit.wrong,
                    "doubtful": i in fit.doubtful,
                }
                for i in range(len(spots))
            ],
        }
        try:
            prior = prior_of_picks(image.name, points, fit, self._upright(image))
        except FeatureDbError as error:
            return found | {"ready": False, "message": str(error)}
        east, north, up = self.cloud.frame.utm_from_enu(prior.cam_from_local.center, self.epsg)
        names = ", ".join(str(i + 1) for i in fit.wrong)
        wrong = f"pick {names} contradicts the others. " if names else ""
        return found | {
            "ready": True,
            "message": f"{wrong}Camera at {east:.1f} E, {north:.1f} N, {up:.1f} m (EPSG:{self.epsg}), to "
            f"{prior.sigma_horizontal_m:.1f} m and {prior.sigma_tilt_deg:.1f} degrees",
        }

    def overlay_png(self, image_id: int) -> bytes:
        """The scan's edges as the photo's camera sees them by the picks, transparent elsewhere.

        Raises:
            InvalidValueError: the picks have not given a pose.
        """
        fit = self._fits.get(image_id)
        if fit is None:
            raise InvalidValueError("the picks give no pose yet")
        return png(edge_layer(scan_view(self.cloud, fit.camera, fit.cam_from_local)))

    def refine(self, image_id: int, spots: Sequence[PickedSpot]) -> dict[str, Any]:
        """Register the photo to the scan from its picks, and others from where the map then has them."""
        image = self.image(image_id)
        with self._work:
            self._write_picks(image, spots)
            self._proposed = anchor(self.database, self._request(image))
            frames = [
                {
                    "name": f.image.name,
                    "accepted": f.registration.accepted,
                    "message": f.registration.message or "registered",
                    "reason": f.registration.reason or "",
                }
                for f in self._proposed.report.tried.tried
            ]
            return {"proposed": list(self._proposed.proposed), "frames": frames}

    def confirm(self, image_id: int) -> dict[str, Any]:
        """Place the whole map by the frames that were registered, and commit it."""
        image = self.image(image_id)
        with self._work:
            if self._proposed is None or image.name not in self._proposed.proposed:
                raise InvalidValueError(f"{image.name} has not been registered to the scan; refine it first")
            done = anchor(self.database, self._request(image, self._proposed.proposed))
            result = done.report.result
            assert result is not None
            undo = f"featuredb rollback {self.database.url} {done.version_before}"
            return {
                "placed": done.placed,
                "message": result.message,
                "reason": result.reason or "",
                "median_m": None if result.after is None else median_m(result.after),
                "version": done.version,
                "undo": undo if done.placed else "",
                "report": str(done.page),
            }

    def _request(self, image: MapImage, confirm: tuple[str, ...] = ()) -> AnchorRequest:
        placed_before = confirm and not isinstance(self.map, UnplacedMap)
        picked = StartFiles(picks=self.out / PICKS_FILE, image=image.name)
        return AnchorRequest(
            map_id=self.map.map_id,
            photos=self.request.photos,
            scan_ids=self.scan_ids,
            out=self.out,
            confirm=confirm,
            start=StartFiles() if placed_before else picked,
            storage_options=self.request.storage_options,
        )

    def _write_picks(self, image: MapImage, spots: Sequence[PickedSpot]) -> None:
        pixels, points = self.spots(spots)
        utm = self.cloud.frame.utm_from_enu(points, self.epsg)
        self.out.mkdir(parents=True, exist_ok=True)
        with (self.out / PICKS_FILE).open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["x", "y", "easting", "northing", "height", "image"])
            writer.writerows(
                [*(round(float(v), 3) for v in (*pixel, *place)), image.name]
                for pixel, place in zip(pixels, utm, strict=True)
            )

    def _upright(self, image: MapImage) -> Rigid3 | None:
        """Where the map has a camera now, in the cloud's frame; None where the map does not know up."""
        if isinstance(self.map, UnplacedMap):
            return image.cam_from_local if self.map.frame.upright else None
        return image.cam_from_local @ self.map.frame.enu_from(self.cloud.frame)
