"""A run of growth goes on while it gets on, and no longer."""

from pathlib import Path

import pytest

from featuredb.store import Database
from ingest.growth import run
from ingest.growth.trust.promotion import Promotion
from ingest.growth.values import GrowthPhotos
from tests.support.few_canaries import few_canaries as few_canaries
from tests.support.growth_box import existing


def test_a_run_ends_though_maps_are_promoted_again_and_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two maps take turns in quarantine: each round promotes one, the third none that is new."""
    rounds: list[str] = []

    def one_of_two(*_: object) -> list[Promotion]:
        rounds.append("ab"[len(rounds) % 2])
        assert len(rounds) < 10
        return [Promotion(map_id=m, promoted=m == rounds[-1], reason_code="", reason="told") for m in "ab"]

    monkeypatch.setattr(run, "promote_confirmed", one_of_two)
    database = Database.create(tmp_path / "db")
    database.commit_map(existing())
    report = run.grow(database, GrowthPhotos(), tmp_path / "work")
    assert report.rounds == 3
    assert report.promoted == ("a",)
