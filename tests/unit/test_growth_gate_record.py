"""The table of what each gate of growth refuses, from judgements that are written by hand."""

import json
from pathlib import Path

import pytest

from tools.growth_gates import gate_rows, main, read_judgements


def line(key: str, right: int, wrong: int, **gates: bool) -> str:
    return json.dumps({"step": "place", "key": key, "right": right, "wrong": wrong, "gates": gates}) + "\n"


def test_what_a_gate_alone_refuses_is_told_from_what_others_refuse_too(tmp_path: Path) -> None:
    path = tmp_path / "gates.jsonl"
    path.write_text(
        line("a b", 2, 0, spread=False, residuals=True)
        + line("a b", 2, 0, spread=True, residuals=True)  # the next round: what counts
        + line("c d e", 0, 3, spread=False, residuals=False)
        + line("f g", 1, 1, spread=True, residuals=False)
    )
    assert gate_rows(read_judgements([path])) == [
        ("place", "spread", 3, 1, 0, 0, 0),
        ("place", "residuals", 3, 2, 1, 1, 1),
    ]


def test_it_prints_what_passes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "gates.jsonl"
    path.write_text(line("a b", 2, 0, spread=True) + line("c", 0, 1, spread=False))
    assert main([str(path)]) == 0
    assert "place: 1 pass, with 2 right and 0 wrong photos" in capsys.readouterr().out
