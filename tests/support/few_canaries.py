"""Fewer of the maps' own images are asked before a grown map may answer."""

import pytest

from ingest.growth.trust import canaries


@pytest.fixture(autouse=True)
def few_canaries(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two around the new map and one elsewhere; what more of them refuse, test_growth_trust says."""
    monkeypatch.setattr(canaries, "_OWN_NEAR", 2)
