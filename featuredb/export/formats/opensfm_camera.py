"""Cameras as OpenSfM has them: lengths over the longer side of the image, from the image's middle.

Reference: OpenSfM, doc/source/geometry.rst. Its pixel (0, 0) is the centre of the top-left pixel, COLMAP's
(0.5, 0.5) is; both have the middle of the image at the same place, so the half pixel drops out.
"""

from typing import Any

from featuredb.errors import ExportError
from featuredb.geometry.camera import Camera

_CENTRED = 1e-12  # of the longer side


def opensfm_camera(camera: Camera) -> dict[str, Any]:
    """The camera as an entry of `cameras` in reconstruction.json.

    "perspective" where that is exact, since every reader knows it; else "brown" or "fisheye_opencv".

    Raises:
        ExportError: the lens has terms that OpenSfM has no room for.
    """
    size = max(camera.width, camera.height)
    pinhole = camera.to_pycolmap()
    lens = {
        "focal_x": pinhole.focal_length_x / size,
        "focal_y": pinhole.focal_length_y / size,
        "c_x": (pinhole.principal_point_x - camera.width / 2.0) / size,
        "c_y": (pinhole.principal_point_y - camera.height / 2.0) / size,
    }
    kind, terms = _distortion(camera)
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


def _distortion(camera: Camera) -> tuple[str, dict[str, float]]:
    """OpenSfM's model and its terms, of the same powers of the tangent, or of a fisheye's angle, as ours."""
    k = camera.params
    none = {"k1": 0.0, "k2": 0.0, "k3": 0.0, "p1": 0.0, "p2": 0.0}
    match camera.model:
        case "SIMPLE_PINHOLE" | "PINHOLE":
            return "brown", none
        case "SIMPLE_RADIAL":
            return "brown", none | {"k1": k[3]}
        case "RADIAL":
            return "brown", none | {"k1": k[3], "k2": k[4]}
        case "OPENCV":
            return "brown", none | {"k1": k[4], "k2": k[5], "p1": k[6], "p2": k[7]}
        case "FULL_OPENCV" if not any(k[9:12]):
            return "brown", {"k1": k[4], "k2": k[5], "k3": k[8], "p1": k[6], "p2": k[7]}
        case "SIMPLE_RADIAL_FISHEYE":
            return "fisheye_opencv", {"k1": k[3], "k2": 0.0, "k3": 0.0, "k4": 0.0}
        case "RADIAL_FISHEYE":
            return "fisheye_opencv", {"k1": k[3], "k2": k[4], "k3": 0.0, "k4": 0.0}
        case "OPENCV_FISHEYE":
            return "fisheye_opencv", {"k1": k[4], "k2": k[5], "k3": k[6], "k4": k[7]}
    raise ExportError(
        f"OpenSfM has no camera for {camera.model} with k4, k5, k6 of {k[9:12]}; export as colmap instead"
    )
