"""What becomes of a map while its lens changes from round to round."""

from types import SimpleNamespace
from typing import Any

import pytest

from ingest.executor import no_progress
from ingest.register.anchor import placing
from ingest.register.anchor.placing import place_in_rounds


def _map(focal_px: float) -> Any:
    return SimpleNamespace(cameras=(SimpleNamespace(focal_px=focal_px),))


def _frame(number: int) -> Any:
    image = SimpleNamespace(image_id=number, name=str(number))
    return SimpleNamespace(image=image, registration=SimpleNamespace(accepted=True))


@pytest.mark.parametrize(
    ("rounds", "placed_px", "words"),
    [
        ([(None, 780.0), (None, 780.5)], 780.5, ""),
        ([("CONTROL", 780.0), (None, 780.5)], 780.5, ""),  # frames that a wrong lens registered
        ([("REPROJECTION", 780.0), (None, 780.5)], 780.5, ""),
        ([("CONTROL", 900.5)], None, "CONTROL"),  # the lens stays, and so does the contradiction
        ([(None, 780.0), ("CONTROL", 780.5)], None, "CONTROL"),
        ([("LENS", None)], None, "LENS"),
        ([(None, 780.0), ("LENS", None)], 780.0, "LENS"),
    ],
)
def test_the_last_word_is_said_when_the_lens_has_settled(
    monkeypatch: pytest.MonkeyPatch,
    rounds: list[tuple[str | None, float | None]],
    placed_px: float | None,
    words: str,
) -> None:
    left = list(rounds)

    def adjusted(*_: Any) -> Any:
        reason, focal_px = left.pop(0)
        return SimpleNamespace(accepted=reason is None, reason=reason, message="", block=focal_px, figures={})

    monkeypatch.setattr(placing, "project_structure", lambda *_: SimpleNamespace(accepted=True, figures={}))
    monkeypatch.setattr(placing, "adjust_to_scan", adjusted)
    monkeypatch.setattr(placing, "placed_map", lambda *given: _map(given[3].block))
    monkeypatch.setattr(placing, "register_again", lambda _map, _cloud, frames, _read: frames)
    nothing: Any = None
    placed, done, said = place_in_rounds(_map(900.0), [_frame(1), _frame(2)], nothing, nothing, no_progress)
    assert not left
    assert (placed and placed.cameras[0].focal_px) == placed_px
    assert said.startswith(words)
    assert bool(said) == bool(words)
    assert [one.figures["adjustment"]["reason"] for one in done] == [
        reason for reason, focal_px in rounds if focal_px is not None
    ]
