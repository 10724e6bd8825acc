"""What the programs that measure growth share: an anchored database, contributions, errors."""

import argparse
import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from featuredb.features.extractor import ExtractorOptions
from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.world import Truth, read_truth
from featuredb.store import Database
from featuredb.store.candidates.photos import contribute
from featuredb.store.candidates.states import Contribution, candidate_id_of
from ingest.growing import GrowingOptions, grow_candidates
from ingest.growth.map_places import drift_m, places_of
from ingest.map_builder import MapOptions
from ingest.pipeline import IngestOptions, ingest_photos
from ingest.reconstruction import MapMakingOptions
from reloc.localise.result import LocaliseResult
from reloc.localiser import Localiser
from reloc.service.handler import decode_photo, localise_request
from reloc.wire.query import LocaliseWireRequest
from tools.figures import poses_in, say, study_parser, write_figures
from tools.growth_gates import WRONG_M, recorded
from tools.worlds.album import TABLE_FILE, AlbumFact, PlannedPhoto, TownOptions, read_facts, write_album

# The survey's receivers: 1.5 and 2.5 cm of noise, and what the reconstruction adds.
_SURVEY_SIGMA_M = (0.02, 0.03)
_WORKERS = 2
_MAKING = MapMakingOptions(
    extractor=ExtractorOptions(max_features=8000), maps=MapOptions(height_datum="ellipsoidal")
)
GROWING = GrowingOptions(making=_MAKING, workers=_WORKERS)
W = TypeVar("W", bound=TownOptions)
_UNSAID_M = 30.0  # accuracy of a geotag that names none


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Album:
    """An album on disk: the folder of its photos; truth, facts and rows of the table by their names."""

    folder: Path
    truth: Truth
    facts: dict[str, AlbumFact]
    rows: dict[str, dict[str, Any]]

    def of(self, *kinds: str, batch: int | None = None) -> list[AlbumFact]:
        """Facts of these kinds, by name."""
        facts = [self.facts[name] for name in sorted(self.facts)]
        return [fact for fact in facts if fact.kind in kinds and batch in (None, fact.batch)]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registered:
    """A photo of the album in a living map.

    Attributes:
        fact: what it is. map_id, status, generation: of its map.
        offset_m: (3,) east, north, up, registered minus true; None for photos without a true place here.
        drift_m: 95 % bound that its map claims against its anchors; None for anchors.
        bound_m: 95 % bound that its map claims on Earth, the anchors' own uncertainty included.
    """

    fact: AlbumFact
    map_id: str
    status: str
    generation: int
    offset_m: FloatArray | None
    drift_m: float | None
    bound_m: float

    @property
    def error_m(self) -> float:
        """Distance from the truth; infinite where the photo has no business here."""
        return float("inf") if self.offset_m is None else float(np.linalg.norm(self.offset_m))

    @property
    def wrong(self) -> bool:
        return self.error_m > WRONG_M


class Verdict(NamedTuple):
    """One line of the contract: what was measured, and whether it holds."""

    name: str
    text: str
    holds: bool


def world_told(
    doc: str | None, world: type[W], argv: Sequence[str] | None = None
) -> tuple[argparse.Namespace, W]:
    """What a program of a made world is told, its folder made, and the world; `doc`: of its module."""
    parser = study_parser(doc, "--work", "--seed")
    parser.set_defaults(seed=world().seed)
    args = parser.parse_args(argv)
    return args, world(seed=args.seed)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GrowthStudy:
    """An album, and the database that grows by its photos."""

    album: Album
    database: Database

    def anchor(self, survey: str) -> None:
        """Ingest the survey of that folder of the album as an anchor, unless it is there."""
        if any(m.name == survey for m in self.database.snapshot().maps()):
            return
        options = IngestOptions(gps_sigma_m=_SURVEY_SIGMA_M, making=_MAKING, name=survey, workers=_WORKERS)
        report = ingest_photos(self.database, self.album.folder / survey, options)
        placed = [m for m in report.maps if m.status != "refused"]
        if len(placed) != 1:
            raise SystemExit(f"{survey}: expected one anchored map, found {report.maps}")
        say(f"{survey}: {placed[0].photos} photos, {placed[0].points} points")

    def give(self, facts: Iterable[AlbumFact]) -> None:
        """Contribute photos as clients do: the bytes, licence, and the table's position as the prior.

        Each person of the album has a certificate of their own. None has a record: the survey's map, which
        is an anchor, makes one for whoever photographs what it shows.
        """
        contributions = []
        for fact in facts:
            image = self.album.truth.images.get(fact.name)
            size = (1, 1) if image is None else (image.camera.width, image.camera.height)
            row = self.album.rows.get(fact.name, {})
            request: dict[str, Any] = {}
            if row.get("lat") is not None:
                accuracy = row["accuracy"] or _UNSAID_M
                request["prior"] = {"lat": row["lat"], "lon": row["lon"], "sigma_m": accuracy}
            contributions.append(
                Contribution(
                    image=(self.album.folder / fact.name).read_bytes(),
                    width=size[0],
                    height=size[1],
                    owner=fact.owner,
                    credit=fact.owner,
                    licence=fact.licence,
                    received_at=datetime.now(UTC),
                    request=request,
                )
            )
        contribute(self.database, contributions)

    def grown(self, gates: str = "gates") -> Counter[str]:
        """Grow once: how many photos wait, by reason. What the gates say is recorded beside the database
        (`tools.growth_gates`), under the name `gates`."""

        def true_place(name: str) -> FloatArray | None:
            image = self.album.truth.images.get(_album_name(self.album, name))
            return None if image is None else image.cam_from_local.center

        gates_file = Path(self.database.url).with_name(f"{gates}.jsonl")
        with recorded(gates_file, self.album.truth.frame, true_place):
            report = grow_candidates(self.database, GROWING)
        for line in report.as_text().splitlines():
            say(line[:300])
        return Counter(p.reason_code for p in report.photos if p.reason_code)

    def registered(self) -> list[Registered]:
        """All photos of the album in living maps, anchors included, with their errors."""
        found: list[Registered] = []
        snapshot = self.database.snapshot()
        for summary in snapshot.maps():
            feature_map = snapshot.load_map(summary.map_id)
            bound_m = drift_m(feature_map.placement.covariance, places_of(feature_map))
            for name, pose in poses_in(self.album.truth.frame, feature_map).items():
                fact = self.album.facts[_album_name(self.album, name, feature_map.name)]
                true = self.album.truth.images.get(fact.name)
                offset = None if true is None else pose.center - true.cam_from_local.center
                found.append(
                    Registered(
                        fact=fact,
                        map_id=summary.map_id,
                        status=summary.status,
                        generation=summary.generation,
                        offset_m=offset,
                        drift_m=summary.drift_m,
                        bound_m=bound_m,
                    )
                )
        return found


def surveyed(
    doc: str | None, world: type[W], plan: Callable[[W], list[PlannedPhoto]]
) -> tuple[argparse.Namespace, W, GrowthStudy]:
    """What `world_told` says, and a study of the world's album, made or finished unless it is complete, and
    a database of its survey; `plan` gives the album's photos."""
    args, options = world_told(doc, world)
    folder = args.work / "world"

    def progress(done: int, total: int) -> None:
        if done % 100 == 0 or done == total:
            say(f"{done} of {total} photos")

    write_album(folder, options, partial(plan, options), progress=progress)
    lines = (folder / TABLE_FILE).read_text(encoding="utf-8").splitlines()
    rows = {row["path"]: row for row in map(json.loads, lines)}
    album = Album(folder=folder, truth=read_truth(folder), facts=read_facts(folder), rows=rows)
    study = GrowthStudy(album=album, database=Database.create(args.work / "db"))
    study.anchor("survey")
    return args, options, study


@lru_cache(maxsize=64)
def _candidate_names(folder: Path) -> dict[str, str]:
    """Names of the album's photos by their candidate ids."""
    return {
        candidate_id_of(path.read_bytes()): path.relative_to(folder).as_posix()
        for path in sorted(folder.rglob("*.jpg"))
    }


def _album_name(album: Album, name: str, folder: str = "") -> str:
    """A photo's name in the album: contributed ones are named by their ids."""
    stem = name.rsplit("/", 1)[-1].split(".")[0]
    for tried in (name, f"{folder}/{name}", _candidate_names(album.folder).get(stem, "")):
        if tried in album.facts:
            return tried
    raise SystemExit(f"photo {name} is not one of {album.folder}")


def answer_of(localiser: Localiser, photo: Path) -> LocaliseResult:
    """The answer to a photo, asked as a client does that knows nothing but the file."""
    data = photo.read_bytes()
    gray, header = decode_photo(data, localiser)
    return localiser.localise(gray, localise_request(LocaliseWireRequest(), data, header), header.size)


def conclude(path: Path | None, verdicts: Sequence[Verdict], lost: int) -> None:
    """Print what was measured, and write it to a path.

    Args:
        lost: photos that a step lost by an exception that it did not foresee, not by a reason.
    """
    verdicts = [*verdicts, Verdict("no step failed", f"{lost} photos lost by an exception", lost == 0)]
    failed = [v.name for v in verdicts if not v.holds]
    say(f"does not hold: {', '.join(failed) or 'nothing'}")
    summary = "; ".join(f"{v.name}: {v.text}" for v in verdicts)
    write_figures(path, {"failed": len(failed), "summary": summary})
