"""What each gate of growth refuses, and what it alone refuses, beside the truth.

    python -m tools.growth_gates gates.jsonl ... [--json FILE]

The programs that measure growth record every judgement into gates.jsonl of their folder: of each placement
that was tried, of each refined one, of each map's drift, and of each map in quarantine. All gates of a
judgement are asked, so it can be told afterwards what would have passed without one of them. The photos of a
judgement are compared with their true places as it would have them.

Prints for each gate the judgements it was asked in, those it refused, and those that nothing but it refused:
their right photos, and those that are wrong by more than 2 m or have no place there at all. A gate that alone
refuses right photos and no wrong ones costs photos and prevents nothing. The same photos are judged once a
round; only the last counts.
"""

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap
from ingest.growth import gates, run
from ingest.growth.gates import Gate
from ingest.growth.graph import map_graph
from ingest.growth.place import component
from ingest.growth.values import Refused
from ingest.photos.photo import Photo
from tools.figures import study_parser, write_figures

WRONG_M = 2.0  # a photo registered further off than this is wrong

TruePlace = Callable[[str], FloatArray | None]
"""A photo's true centre in the truth's frame, by name; None for one that has no place there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """One question to all gates of a step: "place", "refine", "budget" or "trust".

    Attributes:
        key: of the photos, sorted. right, wrong: photos as they would lie. gates: whether each passes.
    """

    step: str
    key: str
    right: int
    wrong: int
    gates: dict[str, bool]

    @property
    def refused_by(self) -> list[str]:
        return [name for name, passes in self.gates.items() if not passes]


@contextmanager
def recorded(path: Path, frame: LocalFrame, true_place: TruePlace) -> Iterator[None]:
    """Append every judgement of growth to a file as long as it lasts; `frame`: of the true places."""
    with ExitStack() as stack, path.open("a", encoding="utf-8") as file:
        note = _Note(file=file, frame=frame, true_place=true_place)
        for module, name, told in (
            (component, "place_by_maps", note.placed),
            (component, "refine_placed", note.refined),
            (map_graph, "with_drift", note.drifted),
            (run, "promote_confirmed", note.promoted),
        ):
            stack.enter_context(patch.object(module, name, _noted(getattr(module, name), told)))
        yield


def _noted(step: Callable[..., Any], told: Callable[..., None]) -> Callable[..., Any]:
    """A step of growth; `told` gets what it gives, and what it was given."""

    def called(*args: Any, **more: Any) -> Any:
        result = step(*args, **more)
        told(result, *args)
        return result

    return called


class _Note:
    """Writes down the judgement of each step of growth."""

    def __init__(self, *, file: Any, frame: LocalFrame, true_place: TruePlace) -> None:
        self._file, self._frame, self._true_place = file, frame, true_place
        self._photos: Sequence[Photo] = ()

    def placed(
        self, placement: Any, model: Any, localised: Any, keypoints: Any, photos: Any, *_: Any
    ) -> None:
        self._photos = photos
        self._model("place", model, placement, _said(placement.gates))

    def refined(self, refined: Any, model: Any, placement: Any, *_: Any) -> None:
        refused = isinstance(refined, Refused)
        asked = refined.gates if refused else refined.placement.gates
        own = {n: yes for n, yes in _said(asked).items() if n not in _said(placement.gates)}
        if refused and all(own.values()):  # by photos that are left out
            own[f"photos: {refined.reason}"] = False
        self._model("refine", model, placement, own)

    def drifted(self, found: Any, grown: Any, maps: Any, budget_m: float) -> None:
        self._map("budget", found[0], _said([gates.drift(found[1], budget_m)]))

    def promoted(self, outcomes: Any, database: Any, *_: Any) -> None:
        for outcome in outcomes:
            if outcome.gates:
                said = {name: bool(gate["passes"]) for name, gate in outcome.gates.items()}
                self._map("trust", database.snapshot().load_map(outcome.map_id), said)

    def _model(self, step: str, model: Any, placement: Any, gates: dict[str, bool]) -> None:
        if isinstance(placement, Refused):  # nothing fits
            return
        names = [self._photos[int(row)].name for row in model.rows]
        centers = placement.fit.local_from_sfm.act(model.centers())
        self._write(step, names, self._frame.enu_from(placement.frame).act(centers), gates)

    def _map(self, step: str, feature_map: FeatureMap, gates: dict[str, bool]) -> None:
        centers = np.array([image.cam_from_local.center for image in feature_map.images])
        names = [image.name for image in feature_map.images]
        self._write(step, names, self._frame.enu_from(feature_map.frame).act(centers), gates)

    def _write(self, step: str, names: Sequence[str], centers: FloatArray, gates: dict[str, bool]) -> None:
        wrong = 0
        for name, center in zip(names, centers, strict=True):
            true = self._true_place(name)
            wrong += true is None or float(np.linalg.norm(center - true)) > WRONG_M
        right, key = len(names) - wrong, " ".join(sorted(names))
        line = asdict(Judgement(step=step, key=key, right=right, wrong=wrong, gates=gates))
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()


def _said(gates: Iterable[Gate]) -> dict[str, bool]:
    """Which gates pass, by name."""
    return {gate.name: bool(gate.passes) for gate in gates}


def read_judgements(paths: Sequence[Path]) -> list[Judgement]:
    """The last judgement of the same photos by the same step, of each file."""
    found: dict[tuple[Path, str, str], Judgement] = {}
    for path in paths:
        for line in path.read_text(encoding="utf-8").splitlines():
            one = Judgement(**json.loads(line))
            found[path, one.step, one.key] = one
    return list(found.values())


def gate_rows(judgements: Iterable[Judgement]) -> list[tuple[str, str, int, int, int, int, int]]:
    """Step, gate, judgements asked, refused, refused by it alone, right and wrong photos of these."""
    judgements = list(judgements)
    rows = []
    for step, gate in dict.fromkeys((j.step, gate) for j in judgements for gate in j.gates):
        asked = [j for j in judgements if j.step == step and gate in j.gates]
        refused = [j for j in asked if not j.gates[gate]]
        alone = [j for j in refused if j.refused_by == [gate]]
        right, wrong = sum(j.right for j in alone), sum(j.wrong for j in alone)
        rows.append((step, gate, len(asked), len(refused), len(alone), right, wrong))
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    parser = study_parser(__doc__)
    parser.add_argument("files", type=Path, nargs="+", metavar="gates.jsonl")
    args = parser.parse_args(argv)
    judgements = read_judgements(args.files)
    rows = gate_rows(judgements)
    sys.stdout.write("step    gate                      asked refused  alone  right  wrong\n")
    for step, gate, *counts in rows:
        sys.stdout.write(f"{step:7} {gate:24}" + "".join(f"{count:7d}" for count in counts) + "\n")
    figures = {
        "judged": sum(j.step == "place" for j in judgements),
        "alone_right": sum(right for *_, right, _ in rows),
        "alone_wrong": sum(wrong for *_, wrong in rows),
    }
    for step in ("place", "refine", "budget", "trust"):
        passed = [j for j in judgements if j.step == step and not j.refused_by]
        right, wrong = sum(j.right for j in passed), sum(j.wrong for j in passed)
        figures |= {f"{step}_right": right, f"{step}_wrong": wrong}
        sys.stdout.write(f"{step}: {len(passed)} pass, with {right} right and {wrong} wrong photos\n")
    write_figures(args.json, figures)
    return 0


if __name__ == "__main__":
    sys.exit(main())
