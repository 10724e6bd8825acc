"""`featuredb ingest photos --gcp`: photos without GPS get a place from control points."""

import argparse
from pathlib import Path

import numpy as np
import pytest

from featuredb.cli.main import run_command
from featuredb.store import Database
from ingest.cli.ingest import register
from tests.support.hill_photos import CAMERA, FRAME, HillPhoto, hill_height, write_hill_photos
from tests.support.scenes import pixels_inside

_EPSG = 32632
_EAST = np.array([-14.0, 12.0, -10.0, 13.0, 0.0, 3.0])
_NORTH = np.array([-9.0, -11.0, 10.0, 9.0, 1.0, -6.0])


def _survey(photos: list[HillPhoto]) -> str:
    """Six points on the hills, marked wherever a photo shows them."""
    places = np.column_stack([_EAST, _NORTH, hill_height(_EAST, _NORTH)])
    utm = FRAME.utm_from_enu(places, _EPSG)
    lines = []
    for photo in photos:
        pixels, inside = pixels_inside(CAMERA, photo.cam_from_local, places)
        lines += [
            f"{utm[p, 0]:.3f} {utm[p, 1]:.3f} {utm[p, 2]:.3f} {pixels[p, 0]:.2f} {pixels[p, 1]:.2f} "
            f"{photo.name} p{p}"
            for p in np.flatnonzero(inside)
        ]
    return "\n".join(["WGS84 UTM 32N", *lines]) + "\n"


def _run(*arguments: str | Path) -> int:
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers(required=True))
    parsed = parser.parse_args(["ingest", "photos", *map(str, arguments), "--workers", "1", "--quiet"])
    return run_command(parsed.run, parsed)


def test_control_points_place_photos_without_gps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos = write_hill_photos(tmp_path / "photos", columns=3, rows=2, with_gps=False)
    survey = tmp_path / "gcp_list.txt"
    survey.write_text(_survey(photos))
    arguments = (tmp_path / "db", tmp_path / "photos", "--max-features", "1500")
    assert _run(*arguments, "--gcp", survey, "--report", tmp_path / "report") == 0
    assert "6 of 6 points used" in capsys.readouterr().out
    snapshot = Database.open(tmp_path / "db").snapshot()
    (summary,) = snapshot.maps()
    feature_map = snapshot.load_map(summary.map_id)
    assert feature_map.placement.method == "gcp"
    points = feature_map.points_local(FRAME)
    assert np.median(np.abs(points[:, 2] - hill_height(points[:, 0], points[:, 1]))) < 0.2
    truth = {p.name: p.cam_from_local.center for p in photos}
    to_truth = FRAME.enu_from(feature_map.frame)
    for image in feature_map.images:
        center = to_truth.act(image.cam_from_local.center)
        assert np.abs(center - truth[image.name]).max() < 1.0
    assert "Control points" in (tmp_path / "report" / "report.html").read_text()
    # The same photos again, by other points: the map stays, and the way to place it anew is told.
    assert _run(*arguments, "--gcp", survey) == 0
    assert "featuredb register DB MAP --gcp FILE" in capsys.readouterr().out
