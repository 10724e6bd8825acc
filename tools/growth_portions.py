"""Real photos in three portions: a first map, the others added by growth, compared with all at once.

1. Joint: all photos are reconstructed at once. The largest reconstruction is the reference.
2. Portions: the photos, sorted by name, are cut into three, by turns (interleaved) or one after the other
   (consecutive). The first reconstruction of at least five photos is placed by GPS,
   or without GPS at a made-up place with a median viewing distance of 50 m. Photos of later portions are
   reconstructed among themselves and go through `ingest.growth.run.grow`, as photos of whoever keeps the
   database. What cannot be placed waits, is tried with the next portion, and once
   more at the end.
3. Camera centres of both are compared after a similarity, in metres for photos with GPS. Without GPS a
   metre is a hundredth of the extent of the camera centres (diagonal of their box), and the drift budget,
   which is in metres, is left out.
"""

import tempfile
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3, similarity_closed_form
from featuredb.maps.feature_map import FeatureMap, Placement
from featuredb.store import Database
from ingest.colmap.bridge import Model
from ingest.executor import InProcessExecutor
from ingest.fingerprint import digest
from ingest.growing import reconstructed_photos
from ingest.growth.run import grow
from ingest.growth.values import GrowthOptions
from ingest.map_builder import MapIdentity, build_map
from ingest.photos.photo import Photo
from ingest.photos.scan import ScanOptions, require_usable, scan_folder
from ingest.placed_models import Component, place_models
from ingest.reconstruction import MapMakingOptions, Reconstructed, reconstruct_photos
from ingest.sfm.extract import features_key, read_features
from ingest.workspace import Workspace
from tools.figures import laid_apart, poses_in, say, spread, study_parser, write_figures
from tools.growth_gates import recorded

_PORTIONS = 3
_LEAST_FIRST = 5  # photos of the first map: three or four do not tell its lens from its heights
_MADE_UP_FRAME = LocalFrame(latitude_deg=48.0, longitude_deg=9.0, height_m=300.0)
_MADE_UP_DISTANCE_M = 50.0
_EXTENT_M = 100.0  # of the camera centres of a set without GPS, when the two are compared
_OWNER = "portions"
_NO_BUDGET_M = 1e6
_MAKING = MapMakingOptions()


@dataclass(slots=True, kw_only=True)
class State:
    """What the run has come to.

    Attributes:
        photos: all of the set. waiting: rows that are in no map yet.
        poses: of registered photos in `frame`, which is the first map's, by name.
        growth: without a drift budget where the first map's metre is made up.
        joint: the joint reconstruction. gates: where what the gates say is recorded, beside its places.
    """

    photos: list[Photo]
    work: Path
    database: Database
    waiting: list[int] = field(default_factory=list)
    poses: dict[str, Rigid3] = field(default_factory=dict)
    frame: LocalFrame | None = None
    growth: GrowthOptions = field(default_factory=GrowthOptions)
    joint: Component
    gates: Path | None = None

    @property
    def joint_poses(self) -> dict[str, Rigid3]:
        """In the joint reconstruction's own frame, by name."""
        names = (photo.name for photo in self.joint.photos)
        return dict(zip(names, self.joint.model.cam_from_sfm, strict=True))


def main() -> None:
    parser = study_parser(__doc__, "--photos", "--work")
    parser.add_argument("--cut", choices=("interleaved", "consecutive"), default="interleaved")
    parser.add_argument("--gates", type=Path, default=None, help="record what gates say (tools.growth_gates)")
    args = parser.parse_args()
    found = require_usable(scan_folder(args.photos, ScanOptions()), args.photos, least=2)
    photos = [replace(photo, owner=_OWNER) for photo in found]
    joint = _reconstruct(photos, list(range(len(photos))), args.work)[0]
    with tempfile.TemporaryDirectory() as scratch:
        database = Database.create(Path(scratch) / "portions")
        state = State(photos=photos, work=args.work, database=database, joint=joint, gates=args.gates)
        for rows in [*portions(len(photos), args.cut), []]:
            state.waiting = sorted([*state.waiting, *rows])
            _take_in(state)
    write_figures(args.json, _judged(state))


def portions(count: int, cut: str) -> list[list[int]]:
    """Rows of the three portions: by turns, or one after the other."""
    rows = np.arange(count)
    by_turns = [rows[i::_PORTIONS] for i in range(_PORTIONS)]
    return [part.tolist() for part in (by_turns if cut == "interleaved" else np.array_split(rows, _PORTIONS))]


def _take_in(state: State) -> None:
    """Make the first map, or grow."""
    if state.frame is None:
        _first_map(state)
    if state.frame is not None and state.waiting:
        made = _reconstructed(state.photos, state.waiting, state.work)
        with _recording(state, state.frame):
            report = grow(state.database, reconstructed_photos(made), state.work / "growth", state.growth)
        say(f"{report.as_text()}")
        _find_poses(state)


def _first_map(state: State) -> None:
    for component in _reconstruct(state.photos, state.waiting, state.work):
        if len(component.photos) < _LEAST_FIRST:
            break
        if first := component.feature_map or _made_up(state, component):
            if component.feature_map is None:
                state.growth = GrowthOptions(drift_budget_m=_NO_BUDGET_M)
            state.database.commit_maps([first])
            _find_poses(state)
            return


def _made_up(state: State, component: Component) -> FeatureMap | None:
    """A map without GPS at a made-up place; None for one whose GPS was refused."""
    if any(photo.gps is not None for photo in component.photos):
        return None
    scale = _MADE_UP_DISTANCE_M / _reach(component.model)
    placement = Placement(
        method="gcp",
        local_from_sfm=replace(Sim3.identity(), scale=scale),
        covariance=np.diag([1e-8, 1e-8, 1e-8, 1e-8, 1e-4, 1e-4, 1e-4]),
        residual_rms_m=0.0,
        evidence={"made_up": True},
    )
    key, kept = features_key(_MAKING.extractor), Workspace(root=state.work)
    features = [read_features(kept.features(key, photo.sha256)) for photo in component.photos]
    identity, photos = _identity([state.photos.index(photo) for photo in component.photos]), component.photos
    return build_map(component.model, placement, _MADE_UP_FRAME, photos, features, identity, _MAKING.maps)


def _reach(model: Model) -> float:
    """Median distance of what its photos see, in its own unit."""
    offsets = model.xyz[model.point_of] - model.centers()[model.photo_of]
    return float(np.median(np.linalg.norm(offsets, axis=1)))


def _recording(state: State, frame: LocalFrame) -> AbstractContextManager[None]:
    """The joint reconstruction's places, carried to the first map's frame by the photos that are in both.

    By what they look at as well: centres on a line leave the turn about it open.
    """
    joint = state.joint_poses
    both = sorted(joint.keys() & state.poses.keys())
    if len(both) < 3 or state.gates is None:
        return nullcontext()
    pairs = [[of[name] for name in both] for of in (joint, state.poses)]
    extents = [np.linalg.norm(np.std([pose.center for pose in of], axis=0)) for of in pairs]  # however turned
    seen = []
    for of, extent in zip(pairs, extents, strict=True):
        looks = _reach(state.joint.model) * float(extent / extents[0]) * np.eye(4, 3, -1)
        seen.append(np.concatenate([pose.center + looks @ pose.rotation for pose in of]))
    carried = similarity_closed_form(*seen)
    if carried is None:
        return nullcontext()

    def place(name: str) -> FloatArray | None:
        return carried.act(joint[name].center) if name in joint else None

    return recorded(state.gates, frame, place)


def _find_poses(state: State) -> None:
    """Where the active maps have the photos, in the frame of the first map."""
    snapshot = state.database.snapshot()
    for summary in snapshot.maps():
        if summary.status == "active":
            feature_map = snapshot.load_map(summary.map_id)
            state.frame = state.frame or feature_map.frame
            state.poses |= poses_in(state.frame, feature_map)
    state.waiting = [r for r in state.waiting if state.photos[r].name not in state.poses]


def _reconstruct(photos: Sequence[Photo], rows: Sequence[int], work: Path) -> list[Component]:
    """Reconstructions of the photos of the given rows, largest first."""
    made = _reconstructed(photos, rows, work)
    done = place_models(made, _MAKING, identity=lambda number: _identity([*rows, number]))
    return sorted(done, key=lambda c: -len(c.photos))


def _reconstructed(photos: Sequence[Photo], rows: Sequence[int], work: Path) -> Reconstructed:
    chosen = [photos[r] for r in rows]
    return reconstruct_photos(chosen, Workspace(root=work), _MAKING, InProcessExecutor())


def _identity(rows: Sequence[int]) -> MapIdentity:
    name = f"of-{rows[0]}-{digest(*map(str, rows))[:8]}"
    return MapIdentity(map_id=name, name=name, source="photos", licence="", provenance={})


def _judged(state: State) -> dict[str, float]:
    """Where growth has the photos against the joint reconstruction."""
    placed = state.joint.placement
    sim = placed.local_from_sfm if placed.reason is None else None
    scale = _EXTENT_M / float(np.linalg.norm(np.ptp(state.joint.model.centers(), axis=0)))
    sim = sim or replace(Sim3.identity(), scale=scale)
    reference = {name: sim.act(pose.center) for name, pose in state.joint_poses.items()}
    apart = laid_apart({name: pose.center for name, pose in state.poses.items()}, reference)
    return {
        "joint": len(reference),
        "grown": len(apart),
        "missing": len(reference.keys() - state.poses.keys()),
        **spread(apart),
    }


if __name__ == "__main__":
    main()
