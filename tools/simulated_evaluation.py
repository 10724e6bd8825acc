"""How good are the answers on the simulated world, and do their reported uncertainties mean something?

Makes a world whose drone photos carry exact positions, ingests them (both are kept in DIR and reused), asks
for every held-out photo and every negative, and compares with the truth:

- held-out drone photos within 0.25 m and 0.3 degrees;
- wrong answers, more than 5 m off, and answers to negatives, which have no place at all;
- shares of errors within the reported 68 % radii, over placements. One map has one bias of its receiver, and
  68 % of one means nothing. So the same reconstruction is placed again by many drawn positions of a survey's
  receiver, the answers move with it, and the errors of all draws are counted. The reconstruction itself stays
  that of the exact positions.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from featuredb.geometry.error_radius import error_radius
from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.area import Area
from featuredb.maps.feature_map import FeatureMap
from featuredb.simworld.scoring import PoseError, pose_difference, summarise
from featuredb.simworld.world import World
from featuredb.store import Database
from ingest.demo import ingest_world, make_world
from ingest.register.gps import place_by_gps
from reloc.localise.answer import placement_covariance
from reloc.localise.result import LocalisedPose
from reloc.localiser import Localiser
from tools.figures import pose_offset, poses_in, study_parser, write_figures
from tools.growth_common import answer_of

_DRAWS = 300  # of placements
_SIGMA_M = 0.02  # of each axis, as the demo ingests exact positions


class Asked(NamedTuple):
    """One query: the answer, its error, and the true cam_from_local in its frame; None: there is none."""

    pose: LocalisedPose | None
    error: PoseError | None = None
    true: Rigid3 | None = None


def main() -> None:
    args = study_parser(__doc__, "--work", "--seed").parse_args()
    world = make_world(args.work / "world", size="full", seed=args.seed)
    database = Database.create(args.work / "db")
    if not database.snapshot().maps():
        ingest_world(world, database, args.work / "report")
    localiser = Localiser.open(database)
    photos = {
        "drone": world.images("queries"),
        "street": world.images("street"),
        "negatives": world.negatives(),
    }
    asked = {group: [ask(world, localiser, path) for path in paths] for group, paths in photos.items()}
    answers = [one for one in asked["drone"] if one.true]
    (area,) = (indexed.area for indexed in localiser.areas)
    (placed,) = area.maps
    feature_map = database.snapshot().load_map(placed.map_id)
    inside = inside_over_placements(answers, area, feature_map, world, args.seed)
    write_figures(args.json, inside | flat_figures(asked))


def ask(world: World, localiser: Localiser, path: Path) -> Asked:
    """Ask for a photo that is not in the map."""
    pose = answer_of(localiser, path).pose
    true, frame = world.truth.images.get(path.relative_to(world.folder).as_posix()), world.truth.frame
    if pose is None or true is None:
        return Asked(pose)
    error = pose_difference(frame, true.cam_from_local, pose.epsg, pose.utm, pose.cam_from_utm_xyzw)
    return Asked(pose, error, true.cam_from_local @ frame.enu_from(pose.frame))


def flat_figures(asked: dict[str, list[Asked]]) -> dict[str, float]:
    """Answers to held-out drone photos with their errors; answers where there should be none."""
    groups = {group: summarise([a.error for a in of]) for group, of in asked.items()}
    drone = groups["drone"]
    answered = {group: sum(a.pose is not None for a in of) for group, of in asked.items()}
    return {
        "asked": len(asked["drone"]),
        "answered": answered["drone"],
        "within": drone.within,
        "median_m": drone.position_m[0],
        "median_deg": drone.angle_deg[0],
        "wrong": sum(of.wrong for of in groups.values()),
        "negatives": len(asked["negatives"]),
        "negatives_answered": answered["negatives"],
        "street": len(asked["street"]),
        "street_answered": answered["street"],
    }


def inside_over_placements(
    answers: Sequence[Asked], area: Area, feature_map: FeatureMap, world: World, seed: int
) -> dict[str, float]:
    """Shares of errors within the reported 68 % radii, over drawn placements."""
    placement, poses = feature_map.placement, poses_in(feature_map.frame, feature_map)
    names = sorted(poses)  # in the order of the flight
    centers_sfm = placement.local_from_sfm.inverse().act([poses[name].center for name in names])
    true = [world.truth.images[f"drone/{name}"].cam_from_local.center for name in names]
    true_centers = feature_map.frame.enu_from(world.truth.frame).act(true)
    rng = np.random.default_rng((seed, 31))
    part = _SIGMA_M / np.sqrt(2.0)  # half of the variance is shared by the flight
    measured = []  # what answers' covariances hold besides the map's placement, in the area's axes
    for one in answers:
        center = one.pose.cam_from_local.center
        back = np.kron(np.eye(2), one.pose.frame.true_enu_from_enu(center).T)
        measured.append(back @ one.pose.covariance @ back.T - placement_covariance(area, feature_map, center))
    inside = []
    for _ in range(_DRAWS):
        positions = true_centers + rng.normal(0.0, part, 3) + rng.normal(0.0, part, true_centers.shape)
        again = place_by_gps(centers_sfm, positions, np.full(positions.shape, _SIGMA_M))
        if again.reason is not None:
            continue  # a gate refuses it
        told = replace(placement, local_from_sfm=again.local_from_sfm, covariance=again.covariance)
        moved_map = replace(feature_map, placement=told)
        motion = again.local_from_sfm @ placement.local_from_sfm.inverse()
        turn = np.kron(np.eye(2), motion.rotation)
        for one, own in zip(answers, measured, strict=True):
            moved = motion.act_on_pose(one.pose.cam_from_local)
            covariance = turn @ own @ turn.T + placement_covariance(area, moved_map, moved.center)
            error = pose_offset(moved, one.true)
            parts = (slice(3, 5), slice(0, 3))  # horizontal, orientation
            inside.append([np.linalg.norm(error[k]) <= error_radius(covariance[k, k]) for k in parts])
    names = ("inside_horizontal", "inside_orientation")
    return dict(zip(names, np.mean(inside, axis=0).tolist(), strict=True))


if __name__ == "__main__":
    main()
