"""What a pipe is told of the stages of an ingest."""

import re
from pathlib import Path

import pytest

from featuredb.errors import FeatureDbError
from ingest import demo
from ingest.api import progress_bars


def test_a_stage_is_told_with_its_own_time(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = [100.0]
    monkeypatch.setattr(progress_bars.time, "monotonic", lambda: now[0])
    with progress_bars.progress_bars() as progress:
        for stage, total, seconds in (("scan", 20, 5.0), ("match", 19, 60.0)):
            progress(stage, total - 1, total)
            now[0] += seconds
            progress(stage, total, total)
    assert re.findall(r"(.+): (\d+) \((.+) s\)", capsys.readouterr().err) == [
        ("Reading files", "20", "5.0"),
        ("Matching each photo with others", "19", "60.0"),
    ]


def test_the_demo_says_what_it_does_before_it_does_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    said: list[str] = []

    def make(*_: object, **__: object) -> None:
        assert "drawing the town and its photos" in said[-1]
        raise FeatureDbError("as far as it goes")

    monkeypatch.setattr(demo, "make_world", make)
    with pytest.raises(FeatureDbError, match="as far"):
        demo.run_demo(tmp_path, size="short", seed=1, say=said.append)
