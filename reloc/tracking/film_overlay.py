"""Frames with what the track knows of them: landmarks, other points of the map, place and state in words."""

import cv2
import numpy as np
from numpy.typing import NDArray

from reloc.tracking.tracked_frame import TrackedFrame
from reloc.tracking.trajectory.values import TrajectoryPoint

_LANDMARK_RGB, _OTHER_RGB = (60, 220, 60), (40, 160, 240)
_STATE_RGB = {"tracking": (60, 220, 60), "relocalised": (250, 210, 40), "lost": (240, 40, 40)}


def draw_frame(rgb: NDArray[np.uint8], frame: TrackedFrame, point: TrajectoryPoint) -> NDArray[np.uint8]:
    """A copy of the frame (h, w, 3) uint8, red first, drawn over.

    Circles are landmarks where the flow has them; dots are points of the map where the pose says they are.
    """
    picture = np.ascontiguousarray(rgb).copy()
    scale = max(picture.shape[:2]) / 1280
    if frame.cam_from_local is not None and frame.ground is not None and frame.camera is not None:
        for x, y in frame.ground.visible(frame.camera, frame.cam_from_local):
            cv2.circle(picture, (round(x), round(y)), max(1, round(scale)), _OTHER_RGB, -1, cv2.LINE_AA)
        for x, y in frame.pixels if frame.pixels is not None else ():
            cv2.circle(picture, (round(x), round(y)), round(4 * scale) + 1, _LANDMARK_RGB, 1, cv2.LINE_AA)
    words = _words(point)
    box = picture[: round((14 + 26 * len(words)) * scale), : round(640 * scale)]
    box //= 3
    for row, text in enumerate(words):
        place = (round(12 * scale), round((28 + 26 * row) * scale))
        cv2.putText(
            picture,
            text,
            place,
            cv2.FONT_HERSHEY_SIMPLEX,
            0.6 * scale,
            _STATE_RGB[point.state],
            1,
            cv2.LINE_AA,
        )
    return picture


def _words(point: TrajectoryPoint) -> list[str]:
    head = f"frame {point.index}  {point.time_s:.2f} s  {point.state}"
    if point.in_map is not None:
        x, y, z = point.in_map.cam_from_map.center
        unit = "m" if point.in_map.frame.metric else "units"
        return [
            f"{head}  {point.inliers} landmarks",
            f"map {point.in_map.map_id[:12]}, no place on Earth",
            f"x {x:.3f}  y {y:.3f}  z {z:.3f} {unit} in its frame",
        ]
    if point.pose is None:
        return [head, point.detail[:80]]
    east, north, up = point.pose.utm
    sigma = float(np.sqrt(np.diag(point.pose.covariance)[3:].sum()))
    heading, pitch, _ = point.pose.geopose.heading_pitch_roll_deg
    return [
        f"{head}  {point.inliers} landmarks",
        f"EPSG:{point.pose.epsg}  {east:.2f} {north:.2f} {up:.2f}  sigma {sigma:.2f} m",
        f"heading {heading:.1f}  pitch {pitch:.1f}",
    ]
