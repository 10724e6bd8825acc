"""The best pose elsewhere: how close the photo came to being answered differently."""

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.area import Area
from reloc.localise.answer import placement_covariance
from reloc.localise.result import RunnerUp
from reloc.localise.search import PoseCandidate


def runner_up(best: PoseCandidate, others: list[PoseCandidate]) -> RunnerUp | None:
    """The pose of another place with most inliers.

    Another place is further than 2 m or 5 degrees from the winner. Where two maps gave the poses, three
    standard deviations of their placements come on top: two maps of one place, each placed by GPS, show it
    metres apart. Heights of different datums are not compared.
    """
    winner = best.pose.cam_from_local
    found: list[RunnerUp] = []
    for other in others:
        pose = _in_frame_of(best.area, other)
        offset = pose.center - winner.center
        if best.main_map.height_datum != other.main_map.height_datum:
            offset[2] = 0.0
        distance_m = float(np.linalg.norm(offset))
        angle_deg = pose.angle_to_deg(winner)
        apart_m, apart_deg = 2.0, 5.0
        if best.main_map.map_id != other.main_map.map_id:
            placed = placement_covariance(best.area, best.main_map, winner.center) + placement_covariance(
                other.area, other.main_map, other.pose.cam_from_local.center
            )
            apart_m += 3.0 * float(np.sqrt(np.linalg.eigvalsh(placed[3:, 3:])[-1]))
            apart_deg += 3.0 * float(np.degrees(np.sqrt(np.linalg.eigvalsh(placed[:3, :3])[-1])))
        inliers = _support_beside(best, other)
        if inliers and (distance_m > apart_m or angle_deg > apart_deg):
            lat, lon, _ = best.area.frame.geodetic_from_enu(pose.center)
            found.append(
                RunnerUp(
                    inliers=inliers,
                    distance_m=distance_m,
                    angle_deg=angle_deg,
                    latitude_deg=float(lat),
                    longitude_deg=float(lon),
                )
            )
    return max(found, key=lambda rival: rival.inliers, default=None)


def _support_beside(best: PoseCandidate, other: PoseCandidate) -> int:
    """Inliers of the other pose that are not inliers of the best one as well.

    Where a photo leaves the pose soft, as a flat place does with an unknown lens, a second estimate comes to
    lie metres away on the very same matches: it speaks of the covariance, not of another place.
    """
    if best.area is not other.area:
        return other.evidence.inliers
    shared = np.isin(_pair_numbers(other), _pair_numbers(best))
    return int(np.count_nonzero(~shared))


def _pair_numbers(candidate: PoseCandidate) -> NDArray[np.int64]:
    """One number for each inlier's pair of feature and point."""
    matches, rows = candidate.matches, candidate.rows
    return matches.feature[rows] * len(candidate.area.points) + matches.point[rows]


def _in_frame_of(area: Area, candidate: PoseCandidate) -> Rigid3:
    if candidate.area is area:
        return candidate.pose.cam_from_local
    return candidate.pose.cam_from_local @ candidate.area.frame.enu_from(area.frame)
