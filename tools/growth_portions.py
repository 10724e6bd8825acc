"""Real photos in three portions: a first map, the others added by growth, compared with all at once.

    uv run python tools/growth_portions.py --photos FOLDER --cut interleaved --work WORK

1. Joint: all photos are reconstructed at once. The largest reconstruction is the reference.
2. Portions: the photos, sorted by name, are cut into three, by turns (interleaved) or one after the other
   (consecutive) or in a shuffled order. The first reconstruction of at least five photos is placed by GPS,
   or without GPS at a made-up place with a median viewing distance of 50 m. Photos of later portions are
   localised by the maps that exist, reconstructed among themselves, placed and refined by growth. What
   cannot be placed waits, is tried with the next portion, and once more at the end. With --adjust all
   maps are then adjusted together, as `featuredb adjust` does.
3. Camera centres of both are compared after a similarity, in metres for photos with GPS. Without GPS a
   metre is a hundredth of the extent of the camera centres (diagonal of their box), and the drift budget,
   which is in metres, is left out.

Prints one line a photo with -v, and one line a set. Exit code 0 if all photos of the reference are
registered and the median difference is at most 0.3 m, else 1. Grown maps are committed as active here: who
confirms them is another question.
"""

import argparse
import logging
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.geometry.similarity import similarity_closed_form
from featuredb.maps.feature_map import FeatureMap, Placement
from featuredb.store import Database
from ingest.executor import InProcessExecutor
from ingest.fingerprint import digest
from ingest.growth.graph.joint.in_database import adjust_maps
from ingest.growth.place.component import GrowOptions
from ingest.growth.place.grow_photos import Grown, GrowPhotosOptions, grow_photos
from ingest.growth.place.localised import localise_photos
from ingest.growth.place.refinement import RefinementOptions
from ingest.growth.values import GrownMap
from ingest.map_builder import MapIdentity, build_map
from ingest.photos.photo import Photo
from ingest.photos.scan import ScanOptions, require_usable, scan_folder
from ingest.placed_models import Component, place_models
from ingest.reconstruction import MapMakingOptions, reconstruct_photos
from ingest.sfm.extract import PhotoFeatures, features_key, read_features
from ingest.workspace import Workspace
from reloc.localiser import Localiser
from tools.figures import add_json_option, write_figures
from tools.growth_common import log_to_stderr
from tools.growth_gates import recorded

_PORTIONS = 3
_LIMIT_M = 0.3
_MADE_UP_FRAME = LocalFrame(latitude_deg=48.0, longitude_deg=9.0, height_m=300.0)
_MADE_UP_DISTANCE_M = 50.0
_EXTENT_M = 100.0  # of the camera centres of a set without GPS, when the two are compared
_WITHOUT_BUDGET = GrowPhotosOptions(grow=GrowOptions(refinement=RefinementOptions(max_photo_bound_m=np.inf)))


@dataclass(slots=True, kw_only=True)
class State:
    """What the run has come to.

    Attributes:
        photos: all of the set. waiting: rows that are in no map yet.
        centers: of registered photos in the first map's frame, metres, by name.
        frame: of the first map.
        growing: without a drift budget where the first map's metre is made up.
        joint: camera centres of the joint reconstruction, in its own frame, by name.
        gates: where what the gates say is recorded, beside the joint reconstruction's places.
    """

    photos: list[Photo]
    making: MapMakingOptions
    work: Path
    database: Database
    least_first: int
    waiting: list[int] = field(default_factory=list)
    centers: dict[str, FloatArray] = field(default_factory=dict)
    frame: LocalFrame | None = None
    growing: GrowPhotosOptions = field(default_factory=GrowPhotosOptions)
    joint: dict[str, FloatArray] = field(default_factory=dict)
    gates: Path | None = None

    def features_of(self, row: int) -> PhotoFeatures:
        """Features of a photo, from the cache of the ingest."""
        workspace = Workspace(root=self.work, job_id="-")
        return read_features(workspace.features(features_key(self.making.extractor), self.photos[row].sha256))


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    log_to_stderr(args.verbose)
    photos = list(require_usable(scan_folder(args.photos, ScanOptions()), args.photos, least=2))
    making = MapMakingOptions()
    started = time.process_time()
    joint = _reconstruct(photos, list(range(len(photos))), making, args.work)[0]
    joint_s = time.process_time() - started
    with tempfile.TemporaryDirectory() as scratch:
        state = State(
            photos=photos,
            making=making,
            work=args.work,
            database=Database.create(Path(scratch) / "portions"),
            least_first=args.first_photos,
            joint={p.name: c for p, c in zip(joint.photos, joint.model.centers(), strict=True)},
            gates=args.gates,
        )
        started = time.process_time()
        cut = portions(len(photos), args.cut, args.seed)
        for number, rows in enumerate([*cut, []], start=1):
            state.waiting = sorted([*state.waiting, *rows])
            _take_in(state, f"portion {number}" if rows else "end")
        if args.adjust:
            _adjust(state)
        grown_s = time.process_time() - started
    return _judge(state, joint, args, joint_s, grown_s)


def portions(count: int, cut: str, seed: int) -> list[list[int]]:
    """Rows of the three portions: by turns, one after the other, or by turns of a shuffled order."""
    rows = np.arange(count)
    if cut == "shuffled":
        rows = np.random.default_rng(seed).permutation(count)
    parts = [rows[i::_PORTIONS] for i in range(_PORTIONS)]
    if cut == "consecutive":
        parts = np.array_split(rows, _PORTIONS)
    return [sorted(part.tolist()) for part in parts]


def _take_in(state: State, what: str) -> None:
    """Make the first map, or grow; as long as something new is registered."""
    if state.frame is None:
        _first_map(state, what)
    while state.frame is not None and state.waiting:
        before = len(state.waiting)
        grown = _grow(state)
        for new in grown.maps:
            _commit(state, replace(new.feature_map, status="active"))
            print(f"  {what}: {_summary(new)}")
        for refused in grown.refused:
            print(f"  {what}: {len(refused.rows)} photos refused, {refused.reason}: {refused.message}")
        if len(state.waiting) == before:
            for row, reason in grown.waiting.items():
                print(f"  {what}: {state.photos[row].name} waits, {reason}")
            return


def _first_map(state: State, what: str) -> None:
    for component in _reconstruct(state.photos, state.waiting, state.making, state.work):
        if len(component.photos) < state.least_first:
            break
        first = component.feature_map or _made_up(state, component)
        if first is not None:
            if component.feature_map is None:
                state.growing = _WITHOUT_BUDGET
            _commit(state, first)
            print(f"  {what}: first map of {len(first.images)} photos, placed by {first.placement.method}")
            return
    print(f"  {what}: no first map, {len(state.waiting)} photos wait")


def _made_up(state: State, component: Component) -> FeatureMap | None:
    """A map without GPS at a made-up place; None for one whose GPS was refused."""
    if any(photo.gps is not None for photo in component.photos):
        return None
    model = component.model
    scale = _MADE_UP_DISTANCE_M / _viewing_distance(component)
    placement = Placement(
        method="gcp",
        local_from_sfm=Sim3(scale=scale, rotation=np.eye(3), translation=np.zeros(3)),
        covariance=np.diag([1e-8, 1e-8, 1e-8, 1e-8, 1e-4, 1e-4, 1e-4]),
        residual_rms_m=0.0,
        evidence={"made_up": True},
    )
    rows = [state.photos.index(photo) for photo in component.photos]
    features = [state.features_of(r) for r in rows]
    return build_map(
        model, placement, _MADE_UP_FRAME, component.photos, features, _identity(rows), state.making.maps
    )


def _viewing_distance(component: Component) -> float:
    model = component.model
    offsets = model.xyz[model.point_of] - model.centers()[model.photo_of]
    return float(np.median(np.linalg.norm(offsets, axis=1)))


def _extent(centers: FloatArray) -> float:
    """Diagonal of the box of camera centres (n, 3)."""
    return float(np.linalg.norm(centers.max(axis=0) - centers.min(axis=0)))


def _grow(state: State) -> Grown:
    """One round over all waiting photos."""
    areas = Localiser.open(state.database).areas
    localised, reasons = localise_photos(state.photos, state.waiting, state.features_of, areas)
    for row, reason in reasons.items():
        logging.info("  %s: %s", state.photos[row].name, reason)
    models = []
    if len(state.waiting) >= 2:
        for component in _reconstruct(state.photos, state.waiting, state.making, state.work):
            rows = np.array([state.waiting[int(r)] for r in component.model.rows])
            models.append(replace(component.model, rows=rows))
    known: list[int] = []
    if localised:
        known = [r for r, photo in enumerate(state.photos) if photo.name in state.centers]
    witnesses, _ = localise_photos(state.photos, known, state.features_of, areas)
    with nullcontext() if state.gates is None else _recording(state, state.gates):
        return grow_photos(
            models,
            state.photos,
            state.features_of,
            localised,
            areas,
            _identity,
            options=state.growing,
            known=witnesses,
        )


def _recording(state: State, gates: Path) -> AbstractContextManager[None]:
    """The joint reconstruction's places, carried to the first map's frame by the photos that are in both."""
    both = sorted(state.joint.keys() & state.centers.keys())
    ours, theirs = (
        np.array([of[name] for name in both]).reshape(-1, 3) for of in (state.centers, state.joint)
    )
    carried = similarity_closed_form(theirs, ours) if len(both) >= 3 else None
    if carried is None or state.frame is None:
        return nullcontext()

    def place(name: str) -> FloatArray | None:
        return carried.act(state.joint[name]) if name in state.joint else None

    return recorded(gates, state.frame, place)


def _commit(state: State, feature_map: FeatureMap) -> None:
    state.database.commit_maps([feature_map])
    state.frame = state.frame or feature_map.frame
    to_first = state.frame.enu_from(feature_map.frame)
    for image in feature_map.images:
        state.centers.setdefault(image.name, to_first.act(image.cam_from_local.center))
    state.waiting = [r for r in state.waiting if state.photos[r].name not in state.centers]


def _adjust(state: State) -> None:
    """All maps adjusted together, as `featuredb adjust` does; camera centres are the new ones then."""
    ids = [m.map_id for m in state.database.snapshot().maps()]
    if len(ids) < 2:
        print("  adjust: nothing to do, there is one map")
        return
    found = adjust_maps(state.database, ids, free=ids)
    print(f"  adjust: {found.message}; {found.adjustment.shared_points} points in several maps")
    for report in found.adjustment.reports:
        moved = f"moved {report.move_m:.2f} m, bent {report.shape_m:.2f} m"
        print(f"    {report.map_id}: {moved}, {report.kept:.1%} of its observations fit")
    assert state.frame is not None
    snapshot = state.database.snapshot()
    for map_id in ids:
        feature_map = snapshot.load_map(map_id)
        to_first = state.frame.enu_from(feature_map.frame)
        for image in feature_map.images:
            state.centers[image.name] = to_first.act(image.cam_from_local.center)


def _reconstruct(
    photos: Sequence[Photo], rows: Sequence[int], making: MapMakingOptions, work: Path
) -> list[Component]:
    """Reconstructions of the photos of the given rows, largest first."""
    chosen = [photos[r] for r in rows]
    job = Workspace(root=work, job_id=digest(making.fingerprint, *(p.sha256 for p in chosen))[:24])
    identity: Callable[[int], MapIdentity] = lambda number: _identity([*rows, number])  # noqa: E731
    made = reconstruct_photos(chosen, job, making, InProcessExecutor())
    done = list(place_models(made, making, identity=identity))
    return sorted(done, key=lambda c: -len(c.photos))


def _identity(rows: Sequence[int]) -> MapIdentity:
    name = f"of-{rows[0]}-{digest(*map(str, rows))[:8]}"
    return MapIdentity(map_id=name, name=name, source="photos", licence="", provenance={})


def _summary(new: GrownMap) -> str:
    growth = new.feature_map.placement.evidence["growth"]
    figures = ", ".join(f"{name} {gate['figure']:.3g}" for name, gate in growth["gates"].items())
    return (
        f"{len(new.feature_map.images)} photos by {len(new.feature_map.parents)} maps, drift "
        f"{growth['drift_m']:.2f} m; {figures}"
    )


def _judge(state: State, joint: Component, args: argparse.Namespace, joint_s: float, grown_s: float) -> int:
    metric = joint.placement.local_from_sfm is not None and joint.placement.reason is None
    sim = joint.placement.local_from_sfm if metric else None
    scale = _EXTENT_M / _extent(joint.model.centers())
    sim = sim or Sim3(scale=scale, rotation=np.eye(3), translation=np.zeros(3))
    reference = {p.name: sim.act(c) for p, c in zip(joint.photos, joint.model.centers(), strict=True)}
    both = sorted(reference.keys() & state.centers.keys())
    ours = np.array([state.centers[name] for name in both]).reshape(-1, 3)
    theirs = np.array([reference[name] for name in both]).reshape(-1, 3)
    aligned = similarity_closed_form(ours, theirs) if len(both) >= 3 else None
    apart = np.linalg.norm(aligned.act(ours) - theirs, axis=1) if aligned else np.full(len(both), np.nan)
    if args.verbose:
        for name, distance in zip(both, apart, strict=True):
            print(f"    {name:<28} {distance:.3f} m")
    missing = sorted(reference.keys() - state.centers.keys())
    median = float(np.median(apart)) if len(both) else float("nan")
    place = np.array(list(reference.values()))
    print(
        f"{args.photos.parent.name + '/' + args.photos.name:<22} {args.cut:<12} photos {len(state.photos)}, "
        f"joint {len(reference)}, grown {len(state.centers)}, of the joint ones {len(both)}; difference "
        f"median {median:.3f} m, largest {apart.max(initial=0):.3f} m; "
        f"{'metres by GPS' if metric else 'own scale'}, extent {_extent(place):.0f} m, viewing distance "
        f"{sim.scale * _viewing_distance(joint):.0f} m; CPU {joint_s:.0f} s joint, {grown_s:.0f} s grown"
        f"{'; missing ' + ', '.join(missing) if missing else ''}"
    )
    largest_m = float(apart.max(initial=0))
    figures = {"photos": len(state.photos), "joint": len(reference), "grown": len(both)}
    write_figures(args.json, figures | {"missing": len(missing), "median_m": median, "largest_m": largest_m})
    return 0 if not missing and median <= _LIMIT_M else 1


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--photos", type=Path, required=True, help="folder of photos")
    parser.add_argument("--cut", choices=("interleaved", "consecutive", "shuffled"), default="interleaved")
    parser.add_argument("--seed", type=int, default=0, help="of the shuffled order")
    parser.add_argument("--work", type=Path, required=True, help="work folder; features and matches are kept")
    parser.add_argument(
        "--first-photos",
        type=int,
        default=5,
        help="least photos of the first map: three or four do not tell its lens from its heights",
    )
    parser.add_argument("--adjust", action="store_true", help="adjust all maps together at the end")
    parser.add_argument("-v", "--verbose", action="store_true", help="one line a photo")
    parser.add_argument("--gates", type=Path, default=None, help="record what gates say (tools.growth_gates)")
    add_json_option(parser)
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
