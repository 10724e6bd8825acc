"""Photos of a simulated world, asked of a server of a database, and how right its answers are."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from featuredb.features.exif.read import read_exif
from featuredb.simworld.scoring import PoseError, pose_error
from featuredb.simworld.truth import Truth
from featuredb.store import Database
from reloc.client import Client
from reloc.service.options import ServeOptions
from reloc.service.serve import start_server
from reloc.shared_lens import lenses_of_cameras, views_of
from reloc.wire.query import CameraRequest, LocaliseReply

Lens = Literal["exif", "known", "shared"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Answered:
    """An answer against the truth.

    Attributes:
        normalised: squared error of the position over its claimed covariance; 3 at the mean is right.
    """

    error: PoseError
    normalised: float


def ask(
    database: Database, truth: Truth, photos: Sequence[Path], *, lens: Lens = "exif"
) -> dict[Path, Answered | None]:
    """What a server answers to photos of the world; None where it does not.

    Args:
        lens: what goes with each photo: nothing but its EXIF; its true intrinsics, as a calibrated camera's
            do; or the lens that the photos of its camera agree on.
    """
    answers: dict[Path, Answered | None] = {}
    with (
        start_server(database, ServeOptions(listen=("tcp/127.0.0.1:0",))) as server,
        Client(server.endpoints[0]) as client,
    ):
        cameras: list[CameraRequest | None] = [None] * len(photos)
        if lens == "known":
            cameras = [_true_camera(truth, photo) for photo in photos]
        elif lens == "shared":
            keys = [read_exif(photo.read_bytes()).camera_key for photo in photos]
            first = [client.localise(photo, timeout_s=60.0, inliers=True) for photo in photos]
            cameras = lenses_of_cameras(keys, views_of(first))[1]
        for photo, camera in zip(photos, cameras, strict=True):
            reply = client.localise(photo, camera=camera, timeout_s=60.0)
            answers[photo] = _against(truth, photo, reply)
    return answers


def _name(photo: Path) -> str:
    return f"{photo.parent.name}/{photo.name}"


def _true_camera(truth: Truth, photo: Path) -> CameraRequest:
    lens = truth.images[_name(photo)].camera
    return CameraRequest(model=lens.model, width=lens.width, height=lens.height, params=lens.params)


def _against(truth: Truth, photo: Path, reply: LocaliseReply) -> Answered | None:
    if reply.utm is None or reply.covariance is None:
        return None
    utm = (reply.utm.easting, reply.utm.northing, reply.utm.height)
    error = pose_error(truth, _name(photo), reply.utm.epsg, utm, reply.utm.cam_from_utm_xyzw)
    offset = np.array([error.east_m, error.north_m, error.up_m])
    claimed = np.array(reply.covariance)[3:, 3:]
    return Answered(error=error, normalised=float(offset @ np.linalg.solve(claimed, offset)))
