"""The README's demo, as a person who has just cloned the repository runs it."""

from dataclasses import replace
from pathlib import Path

import pytest

from featuredb.simworld.flight import FlightOptions
from featuredb.simworld.world import WorldOptions
from tests.support.doc_commands import ROOT, Command, blocks, call_of, commands
from tests.support.doc_folder import inside
from tests.support.doc_runner import PageRun


def demo() -> Command:
    """The command of the README."""
    page = "README.md"
    every = [c for b in blocks(page, (ROOT / page).read_text(encoding="utf-8")) for c in commands(b)]
    (found,) = (c for c in every if call_of(c).arguments[:1] == ("demo",))
    return found


def run_in(folder: Path) -> None:
    with inside(folder), PageRun(folder) as run:
        run.run(demo())
    made = ("db", "world/truth.json", "report/report.html", "overlay.png")
    assert [name for name in made if not (folder / "featuredb-demo" / name).exists()] == []


@pytest.mark.slow
def test_the_demo_holds_on_a_small_town(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It exits with 0 only if most drone photos are answered and nothing is answered wrongly."""
    small = WorldOptions(
        town_size_m=(200.0, 180.0),
        flight=FlightOptions(lines=3, per_line=3, oblique=0, width=512),
        queries=3,
        query_width=512,
        street=1,
        street_width=512,
        negatives_per_kind=1,
        workers=1,
    )
    monkeypatch.setattr(WorldOptions, "short", lambda seed: replace(small, seed=seed))
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # processes of its own take longer to start
    run_in(tmp_path)


@pytest.mark.evaluation
@pytest.mark.timeout(1200)
def test_the_demo_holds(tmp_path: Path) -> None:
    run_in(tmp_path)
