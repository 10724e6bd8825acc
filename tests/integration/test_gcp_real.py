"""Real control points: kite photos of a dune without GPS, ten points, one wrong mark, one bad coordinate."""

import argparse
import json
from pathlib import Path

import numpy as np
import pytest

from featuredb.cli.main import run_command
from featuredb.store import Database
from ingest.cli.ingest import register as register_ingest
from ingest.cli.register import register as register_register


def _run(*arguments: str | Path) -> int:
    parser = argparse.ArgumentParser()
    subparsers = parser.add_subparsers(required=True)
    register_ingest(subparsers)
    register_register(subparsers)
    parsed = parser.parse_args([str(a) for a in arguments])
    return run_command(parsed.run, parsed)


@pytest.mark.real_data
@pytest.mark.slow
@pytest.mark.evaluation
def test_copr_registers_by_its_control_points(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shared_data / "copr"
    survey = folder / "gcp_list.txt"
    made = _run(
        "ingest", "photos", tmp_path / "db", folder / "images", "--gcp", survey, "--quiet",
        "--max-features", "2000", "--max-side", "1600",
    )  # fmt: skip
    assert made == 0
    out = capsys.readouterr().out
    assert "every height is exactly zero" in out
    assert "mark of gcp04 in IMG_0031.jpg (line 6)" in out
    assert "it lies on gcp00" in out
    snapshot = Database.open(tmp_path / "db").snapshot()
    feature_map = snapshot.load_map(snapshot.maps()[0].map_id)
    evidence = feature_map.placement.evidence
    used = [p for p in evidence["points"] if p["used"]]
    horizontal = [np.hypot(*p["residual_enu_m"][:2]) for p in used]
    assert len(used) >= 8
    # The survey itself is good to 0.8 m a coordinate: a median length of 1 m is what that gives.
    assert np.median(horizontal) < 1.05
    assert not next(p for p in evidence["points"] if p["name"] == "gcp06")["used"]

    # Two marks of one photo exchanged, and one shifted by 60 px, are named.
    lines = survey.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if "IMG_0082.jpg gcp08" in line)
    second = next(i for i, line in enumerate(lines) if "IMG_0082.jpg gcp07" in line)
    one, other = lines[first].split(), lines[second].split()
    lines[first] = " ".join([*one[:3], *other[3:5], *one[5:]])
    lines[second] = " ".join([*other[:3], *one[3:5], *other[5:]])
    third = next(i for i, line in enumerate(lines) if "IMG_0064.jpg gcp05" in line)
    lines[third] = lines[third].replace("760.80 614.78", "808.80 578.78")
    spoilt = tmp_path / "spoilt.txt"
    spoilt.write_text("\n".join(lines))
    report = tmp_path / "report"
    assert (
        _run(
            "register", tmp_path / "db", feature_map.map_id, "--gcp", spoilt, "--dry-run", "--report", report
        )
        == 0
    )
    marks = json.loads((report / "control.json").read_text())["marks"]
    wrong = {(m["point"], m["photo"]) for m in marks if not m["used"]}
    assert {
        ("gcp07", "IMG_0082.jpg"),
        ("gcp08", "IMG_0082.jpg"),
        ("gcp05", "IMG_0064.jpg"),
        ("gcp04", "IMG_0031.jpg"),
    } <= wrong
