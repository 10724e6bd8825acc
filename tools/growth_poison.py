"""Poison: look-alike blocks, mirrors, liars and forgers send photos. Is anything wrong promoted?

The world is that of `tools.worlds.poison_world`. The survey is ingested, honest photos are grown, and
held-out photos become canaries with their true poses. Then a copy of that database gets all kinds of poison
together, grows, gets honest photos that come later, and grows again. Whatever is active then is compared with
the truth:

- photos registered more than 2 m off, or without a place in this town at all;
- points of grown maps more than 1 m off the surface that their photo truly sees, over all points of the map
  (pieces that were moved or painted leave poses right and points wrong). Honest maps set the measure: a map
  with twice their share and more than 2 % is wrong.

Then wrong maps are forced in by hand: every quarantined map with poison, and, so that there is always one, an
honest grown map moved by 3 m under a new id. Answers to the canaries and to honest photos are compared,
before, while it is in service, and after `retire`: bit for bit, but for the number of the snapshot.
"""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from featuredb.geometry.rotation import quaternion_from_matrix
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.move import move_map
from featuredb.plain_json import plain
from featuredb.simworld.camera.photograph import render_depth
from featuredb.store import Database
from featuredb.store.canaries import KnownPose, add_canary
from ingest.growth.trust.promotion import promote_by_hand
from reloc.localiser import Localiser
from tools.commands import newest_copy
from tools.growth_common import Album, GrowthStudy, Verdict, answer_of, conclude, surveyed
from tools.worlds.poison_world import POISONS, PoisonOptions, poison_album

_OFF_M, _OFF_SHARE = 1.0, 0.02
_MOVE_M = 3.0
_CANARY_M, _CANARY_DEG = 0.5, 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PoisonOutcome:
    """What the poison did.

    Attributes:
        sent: photos. active: of them, in such maps. wrong: photos of any kind that active maps have wrongly.
        off_share: largest share of points off the true surface among active grown maps with poison.
        forced: maps that were forced in. restored: whether all answers came back. failed: lost photos.
    """

    sent: int
    active: int
    wrong: dict[str, int]
    off_share: float
    forced: int = 0
    restored: bool = True
    failed: int = 0


def main() -> None:
    args, world, honest = surveyed(__doc__, PoisonOptions, poison_album)
    grow_honest(honest)
    clean = max(off_shares(honest, world).values(), default=0.0)
    outcome = try_poison(copied(honest, "db-poisoned"), world)
    forced = copied(honest, "db-forced")
    fabricated = force_and_retire(forced, [moved_copy(forced.database)])
    conclude(args.json, judge(outcome, clean, fabricated), outcome.failed)


def copied(study: GrowthStudy, name: str) -> GrowthStudy:
    """The study on a copy of its database, of that name."""
    source = Path(study.database.url)
    return replace(study, database=Database.open(newest_copy(source, source.with_name(name))))


def grow_honest(study: GrowthStudy) -> None:
    """Honest photos and canaries, before any poison."""
    database, album = study.database, study.album
    if any(m.method == "map" for m in database.snapshot().maps()):
        return
    for fact in album.of("canary"):
        true = album.truth.images[fact.name]
        grid = album.truth.frame.grid_from_enu(true.cam_from_local.center, album.truth.epsg)
        pose = KnownPose(
            epsg=album.truth.epsg,
            utm=true.utm,
            height_datum="ellipsoidal",
            cam_from_utm_xyzw=quaternion_from_matrix(true.cam_from_local.rotation @ grid.T),
            tolerance_m=_CANARY_M,
            tolerance_deg=_CANARY_DEG,
        )
        add_canary(database, fact.photo_id, (album.folder / fact.name).read_bytes(), pose, origin="person")
    study.give(album.of("honest"))
    study.grown()


def try_poison(study: GrowthStudy, world: PoisonOptions) -> PoisonOutcome:
    """All poison on a copy of the honest database."""
    sent = study.album.of(*POISONS)
    failed = 0
    for arrived in (sent, study.album.of("late")):
        study.give(arrived)
        failed += study.grown("gates-poisoned")["FAILED"]
    found = study.registered()
    active = [r for r in found if r.status == "active" and r.generation > 0]
    poisoned = {r.map_id for r in active if r.fact.kind in POISONS}
    shares = off_shares(study, world)
    held = {r.map_id for r in found if r.status == "quarantined" and (r.fact.kind in POISONS or r.wrong)}
    forced = force_and_retire(study, sorted(held))
    return PoisonOutcome(
        sent=len(sent),
        active=sum(r.fact.kind in POISONS for r in active),
        wrong=dict(Counter(r.fact.kind for r in active if r.wrong)),
        off_share=max((shares[m] for m in poisoned if m in shares), default=0.0),
        forced=forced["forced"],
        restored=forced["restored"],
        failed=failed,
    )


def off_shares(study: GrowthStudy, world: PoisonOptions) -> dict[str, float]:
    """For each active grown map, the share of its points' observations off what truly is there."""
    shares, found, snapshot = {}, study.registered(), study.database.snapshot()
    for summary in snapshot.maps():
        if summary.status == "active" and summary.method == "map":
            names = [r.fact.name for r in found if r.map_id == summary.map_id]
            feature_map = snapshot.load_map(summary.map_id)
            shares[summary.map_id] = _off_share(feature_map, study.album, world, names)
    return shares


def _off_share(feature_map: FeatureMap, album: Album, world: PoisonOptions, names: Sequence[str]) -> float:
    """By the depth that the true camera sees at an observation's pixel, where it is no edge."""
    scene, seen = world.scene("home/0/000"), feature_map.observations
    points = album.truth.frame.enu_from(feature_map.frame).act(feature_map.points_local())
    off = total = 0
    for image, name in zip(feature_map.images, names, strict=True):
        if (true := album.truth.images.get(name)) is None:
            continue
        rows = seen.image_id == image.image_id
        depth = render_depth(scene, true.camera, true.cam_from_local).depth
        x, y = np.floor(seen.xy[rows]).astype(int).T
        h, w = depth.shape
        padded = np.pad(depth, 3, mode="edge")
        inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
        x, y = np.clip(x, 0, w - 1), np.clip(y, 0, h - 1)
        around = np.stack([padded[y + 3 + i, x + 3 + j] for i in (-3, 0, 3) for j in (-3, 0, 3)])
        z = true.cam_from_local.act(points[seen.point_index[rows]])[:, 2]
        smooth = inside & np.isfinite(around).all(axis=0)
        smooth[smooth] &= np.ptp(around[:, smooth], axis=0) < 0.5
        off += int((np.abs(z - depth[y, x])[smooth] > _OFF_M).sum())
        total += int(smooth.sum())
    return off / max(total, 1)


def force_and_retire(study: GrowthStudy, held: Sequence[str]) -> dict[str, Any]:
    """Force maps in by hand and take them out again; whether answers changed, and whether they came back."""
    database, before = study.database, answers(study)
    done = [one for one in held if promote_by_hand(database, one, "forced for the test", force=True).promoted]
    during = answers(study) if done else before
    for map_id in done:
        if database.snapshot().get(map_id).status != "retired":
            database.retire(map_id, "it is wrong")
    after = answers(study) if done else before
    return {"forced": len(done), "changed": during != before, "restored": after == before}


def moved_copy(database: Database) -> str:
    """A grown map under a new id, 3 m to the east of where it belongs, in quarantine; its id."""
    source = next((m for m in database.snapshot().maps() if m.method == "map" and m.status == "active"), None)
    if source is None:
        raise SystemExit("no honest map has grown, so there is none to be moved")
    feature_map = database.snapshot().load_map(source.map_id)
    move = Sim3.shift(np.array([_MOVE_M, 0.0, 0.0]))
    wrong = replace(move_map(feature_map, move), map_id="f" * 24, status="quarantined")
    database.commit_map(wrong)
    return wrong.map_id


def answers(study: GrowthStudy) -> dict[str, str]:
    """Every figure of the answers to canaries and honest photos, without times and the snapshot's number."""
    localiser, album = Localiser.open(study.database), study.album
    found = {}
    for fact in [*album.of("canary"), *album.of("honest")[:20]]:
        result = answer_of(localiser, album.folder / fact.name)
        figures: list[Any] = [result.reason, result.inliers, result.matches, result.confidence]
        if (pose := result.pose) is not None:
            figures += [pose.utm, pose.cam_from_utm_xyzw, pose.covariance, pose.map_ids, *pose.lineage]
        found[fact.name] = json.dumps(plain(figures))
    return found


def judge(o: PoisonOutcome, clean: float, fabricated: dict[str, Any]) -> list[Verdict]:
    """The contract's lines."""
    limit = max(_OFF_SHARE, 2.0 * clean)
    kinds = ", ".join(f"{count} {kind}" for kind, count in o.wrong.items())
    return [
        Verdict(
            "poison",
            f"{kinds or 0} photos wrong in active maps, none wanted; {o.active} of {o.sent} registered; "
            f"points off the surface {o.off_share:.1%} of at most {limit:.1%}",
            not o.wrong and o.off_share <= limit,
        ),
        Verdict(
            "retire",
            f"{o.forced} quarantined maps forced in and retired, answers "
            f"{'came back' if o.restored else 'DID NOT COME BACK'}; a map moved by {_MOVE_M} m: "
            f"answers {'changed' if fabricated['changed'] else 'did not change'} and "
            f"{'came back' if fabricated['restored'] else 'DID NOT COME BACK'}",
            o.restored and fabricated["restored"] and fabricated["changed"],
        ),
    ]


if __name__ == "__main__":
    main()
