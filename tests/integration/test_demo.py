"""The README's demo, as a person who has just cloned the repository runs it."""

from pathlib import Path

import pytest

from tests.support.doc_commands import ROOT, Command, blocks, call_of, commands
from tests.support.doc_folder import inside
from tests.support.doc_runner import PageRun


def demo() -> Command:
    """The command of the README."""
    page = "README.md"
    every = [c for b in blocks(page, (ROOT / page).read_text(encoding="utf-8")) for c in commands(b)]
    (found,) = (c for c in every if call_of(c).arguments[:1] == ("demo",))
    return found


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_demo_holds(tmp_path: Path) -> None:
    """It exits with 0 only if most drone photos are answered and nothing is answered wrongly."""
    with inside(tmp_path), PageRun(tmp_path) as run:
        run.run(demo())
    made = ("db", "world/truth.json", "report/report.html", "report/plan.png", "overlay.png")
    assert [name for name in made if not (tmp_path / "featuredb-demo" / name).exists()] == []
