"""How many frames are tried before a map is given up."""

from types import SimpleNamespace
from typing import Any

import pytest

from ingest.register.anchor import frames
from ingest.register.anchor.frames import try_frames


def tried(monkeypatch: pytest.MonkeyPatch, registered: list[bool]) -> int:
    """How many of frames that are registered or not, in their order, are tried."""
    images = [SimpleNamespace(image_id=k, name=str(k)) for k in range(len(registered))]
    proposals = [SimpleNamespace(image=image) for image in images]

    def try_one(_map: Any, _cloud: Any, proposal: Any, *_: Any) -> Any:
        return SimpleNamespace(registration=SimpleNamespace(accepted=registered[proposal.image.image_id]))

    monkeypatch.setattr(frames, "height_shift", lambda *_: None)
    monkeypatch.setattr(frames, "prior_from_map", lambda *_: None)
    monkeypatch.setattr(frames, "propose_frames", lambda *_: proposals)
    monkeypatch.setattr(frames, "register_together", lambda *_: None)
    monkeypatch.setattr(frames, "_try", try_one)
    found = try_frames(SimpleNamespace(images=images), None, lambda _: None, 3, 6)  # type: ignore[arg-type, return-value]
    return len(found.tried)


@pytest.mark.parametrize(
    ("registered", "count"),
    [
        ([True, True, True] + [False] * 30, 3),
        ([False] * 40, 6),
        ([False] * 5 + [True] + [False] * 40, 18),
        ([False, True] * 20, 6),
        ([True, False, False, False] * 10, 9),
        ([False] * 6 + [True] * 20, 6),
        ([True, False], 2),
    ],
)
def test_once_a_frame_is_registered_others_have_more_tries(
    monkeypatch: pytest.MonkeyPatch, registered: list[bool], count: int
) -> None:
    assert tried(monkeypatch, registered) == count
