"""Proposed frames on disk, between the command that proposes them and the one that confirms them."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from featuredb.errors import IngestError, RegistrationError
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from ingest.register.frame_registration import FrameRegistration
from ingest.workspace import read_json, write_json

PROPOSALS = "proposals.json"
_VERSION = 1


State = tuple[str, str, str]
"""Ids of a map, of its state (another one has other poses), and of the scan."""


def save_proposals(folder: Path, state: State, registrations: Mapping[int, FrameRegistration]) -> None:
    """Write folder/proposals.json, atomically: accepted registrations by image id."""
    names = dict(zip(("map_id", "write_id", "scan_id"), state, strict=True))
    frames = {str(i): _plain(r) for i, r in registrations.items() if r.accepted}
    write_json(folder / PROPOSALS, {"version": _VERSION, **names, "frames": frames})


def load_proposals(folder: Path, state: State) -> Mapping[int, FrameRegistration]:
    """Read them back for the same map, in the same state, and the same scan.

    Raises:
        RegistrationError: there are none, or they belong to something else.
    """
    path = folder / PROPOSALS
    if not path.is_file():
        raise RegistrationError(
            f"{path}: nothing has been proposed there; run the command without --confirm first, with "
            "the same --out"
        )
    try:
        document = read_json(path)
        if document["version"] != _VERSION:
            raise RegistrationError(
                f"{path}: expected version {_VERSION}, found {document['version']}; propose anew"
            )
        found = (document["map_id"], document["write_id"], document["scan_id"])
        frames = {int(i): _registration(entry) for i, entry in document["frames"].items()}
    except (IngestError, KeyError, TypeError, ValueError) as error:
        raise RegistrationError(f"{path}: cannot be read as proposals ({error!r}); propose anew") from error
    if found != state:
        raise RegistrationError(
            f"{path}: proposed for map {found[0]}, state {found[1]}, scan {found[2]}; the map is now in "
            f"state {state[1]} with scan {state[2]}; run the command without --confirm again"
        )
    return frames


def _plain(registration: FrameRegistration) -> dict[str, Any]:
    pose, covariance, camera = registration.cam_from_local, registration.covariance, registration.camera
    assert pose is not None
    assert covariance is not None
    return {
        "cam_from_local": pose.matrix().tolist(),
        "covariance": covariance.tolist(),
        "camera": None if camera is None else asdict(camera),
        "source": registration.source,
        "points_local": registration.points_local.tolist(),
        "pixels": registration.pixels.tolist(),
        "evidence": registration.evidence,
        "seconds": registration.seconds,
    }


def _registration(entry: dict[str, Any]) -> FrameRegistration:
    camera = entry["camera"]
    return FrameRegistration(
        cam_from_local=Rigid3.from_matrix(entry["cam_from_local"]),
        covariance=np.array(entry["covariance"]),
        reason=None,
        message="",
        camera=None if camera is None else Camera(**camera | {"params": tuple(camera["params"])}),
        source=entry["source"],
        points_local=np.array(entry["points_local"]).reshape(-1, 3),
        pixels=np.array(entry["pixels"]).reshape(-1, 2),
        evidence=entry["evidence"],
        seconds=entry["seconds"],
    )
