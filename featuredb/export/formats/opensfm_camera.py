"""Cameras as OpenSfM has them: lengths over the longer side of the image, from the image's middle.

Reference: OpenSfM, doc/source/geometry.rst. Its pixel (0, 0) is the centre of the top-left pixel, COLMAP's
(0.5, 0.5) is; both have the middle of the image at the same place, so the half pixel drops out.
"""

from typing import Any

from featuredb.errors import ExportError
from featuredb.geometry.camera import Camera

_CENTRED = 1e-12  # of the longer side
# COLMAP's model: OpenSfM's, and its names of the terms behind the pinhole's, in COLMAP's order. They are of
# the same powers of the tangent, or of a fisheye's angle.
LENS_TERMS: dict[str, tuple[str, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": ("brown", ()),
    "PINHOLE": ("brown", ()),
    "SIMPLE_RADIAL": ("brown", ("k1",)),
    "RADIAL": ("brown", ("k1", "k2")),
    "OPENCV": ("brown", ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": ("brown", ("k1", "k2", "p1", "p2", "k3")),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye_opencv", ("k1",)),
    "RADIAL_FISHEYE": ("fisheye_opencv", ("k1", "k2")),
    "OPENCV_FISHEYE": ("fisheye_opencv", ("k1", "k2", "k3", "k4")),
}
_ALL_TERMS = {"brown": ("k1", "k2", "k3", "p1", "p2"), "fisheye_opencv": ("k1", "k2", "k3", "k4")}


def opensfm_camera(camera: Camera) -> dict[str, Any]:
    """The camera as an entry of `cameras` in reconstruction.json.

    "perspective" where that is exact, since every reader knows it; else "brown" or "fisheye_opencv".

    Raises:
        ExportError: the lens has terms that OpenSfM has no room for.
    """
    size = max(camera.width, camera.height)
    pinhole = camera.to_pycolmap()
    kind, names = LENS_TERMS.get(camera.model, ("", ()))
    given = [camera.params[i] for i in pinhole.extra_params_idxs()]
    if not kind or any(given[len(names) :]):
        raise ExportError(
            f"OpenSfM has no camera for {camera.model} with the terms {given}; export as colmap instead"
        )
    terms = dict.fromkeys(_ALL_TERMS[kind], 0.0) | dict(zip(names, given, strict=False))
    lens = {
        "focal_x": pinhole.focal_length_x / size,
        "focal_y": pinhole.focal_length_y / size,
        "c_x": (pinhole.principal_point_x - camera.width / 2.0) / size,
        "c_y": (pinhole.principal_point_y - camera.height / 2.0) / size,
    }
    common = {"projection_type": kind, "width": camera.width, "height": camera.height}
    centred = abs(lens["c_x"]) < _CENTRED and abs(lens["c_y"]) < _CENTRED
    plain = not (terms.get("p1") or terms.get("p2") or terms.get("k3"))
    if kind == "brown" and centred and plain and lens["focal_x"] == lens["focal_y"]:
        return common | {
            "projection_type": "perspective",
            "focal": lens["focal_x"],
            "k1": terms["k1"],
            "k2": terms["k2"],
        }
    return common | lens | terms
