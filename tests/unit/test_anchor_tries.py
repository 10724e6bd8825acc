"""How many frames are tried before a map is given up."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from ingest.register.anchor import frames
from ingest.register.anchor.frames import try_frames

_COLOURED, _BARE = SimpleNamespace(rgb=True), SimpleNamespace(rgb=None)


def tried(monkeypatch: pytest.MonkeyPatch, registered: Sequence[bool | None]) -> int:
    """How many of frames that are registered or not, or cannot be read (None), in their order, are tried."""
    images = [SimpleNamespace(image_id=k, name=str(k)) for k in range(len(registered))]
    proposals = [SimpleNamespace(image=image) for image in images]

    def try_one(_map: Any, _cloud: Any, proposal: Any, *_: Any) -> Any:
        accepted = registered[proposal.image.image_id]
        if accepted is None:
            return None
        return SimpleNamespace(image=proposal.image, registration=SimpleNamespace(accepted=accepted))

    monkeypatch.setattr(frames, "height_shift", lambda *_: None)
    monkeypatch.setattr(frames, "prior_from_map", lambda *_: None)
    monkeypatch.setattr(frames, "propose_frames", lambda *_: proposals)
    monkeypatch.setattr(frames, "register_together", lambda *_: None)
    monkeypatch.setattr(frames, "_try", try_one)
    found = try_frames(SimpleNamespace(images=images), _COLOURED, lambda _: None, 3)  # type: ignore[arg-type, return-value]
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
        ([None] * 8 + [True, True, True, False], 3),
    ],
)
def test_once_a_frame_is_registered_others_have_more_tries(
    monkeypatch: pytest.MonkeyPatch, registered: list[bool | None], count: int
) -> None:
    assert tried(monkeypatch, registered) == count


@pytest.mark.parametrize(
    ("scan", "registered", "asked", "names"),
    [
        (_COLOURED, [True, True, True], 0, "012"),
        (_COLOURED, [True, False], 1, "1ab"),  # photo 0 is registered by all together, too
        (_BARE, [True, True, True], 1, "ab"),
    ],
)
def test_all_photos_together_are_asked_where_one_does_not_tell(
    monkeypatch: pytest.MonkeyPatch, scan: Any, registered: list[bool], asked: int, names: str
) -> None:
    images = [SimpleNamespace(image_id=k, name=str(k)) for k in range(len(registered))]
    proposals = [SimpleNamespace(image=image) for image in images]
    calls = []

    def frame(image: Any, name: str, accepted: bool) -> Any:
        return SimpleNamespace(image=image, name=name, registration=SimpleNamespace(accepted=accepted))

    def try_one(_map: Any, _cloud: Any, proposal: Any, *_: Any) -> Any:
        return frame(proposal.image, proposal.image.name, registered[proposal.image.image_id])

    def together(*_: Any) -> Any:
        calls.append(1)
        return [frame(images[0], "a", True), frame(SimpleNamespace(image_id=9), "b", True)]

    monkeypatch.setattr(frames, "height_shift", lambda *_: None)
    monkeypatch.setattr(frames, "prior_from_map", lambda *_: None)
    monkeypatch.setattr(frames, "propose_frames", lambda *_: proposals)
    monkeypatch.setattr(frames, "_tried_together", together)
    monkeypatch.setattr(frames, "_try", try_one)
    found = try_frames(SimpleNamespace(images=images), scan, lambda _: None, 3)  # type: ignore[arg-type, return-value]
    assert len(calls) == asked
    assert "".join(one.name for one in found.tried) == names  # type: ignore[attr-defined]
