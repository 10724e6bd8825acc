"""`featuredb anchor --near` on photos from the street: a part is placed, and the rest stays a map."""

import hashlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from featuredb.cli.main import main
from featuredb.lidar.add import add_scan
from featuredb.store import Database
from tests.support.las_files import write_scan
from tests.support.scanned_map import FRAME
from tests.support.street_map import JOIN, OWN_FROM_LOCAL, few_sizes, joined_wrongly, street_map, street_scan

_EPSG = 32632


def test_a_part_is_placed_where_look_alikes_have_joined_two(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Sixteen photos of the street, and as many of it by people who were held for standing in another one."""
    few_sizes(monkeypatch)
    joined = joined_wrongly(street_map(mirrored=False))
    (tmp_path / "photos").mkdir()
    photo = cv2.imencode(".png", np.zeros((60, 80, 3), np.uint8))[1].tobytes()
    (tmp_path / "photos" / joined.images[0].name).write_bytes(photo)
    first = replace(joined.images[0], sha256=hashlib.sha256(photo).hexdigest())
    database = Database.create(tmp_path / "db")
    database.commit_map(replace(joined, images=(first, *joined.images[1:])))
    utm = FRAME.utm_from_enu(street_scan(), _EPSG)
    add_scan(database, [write_scan(tmp_path / "scan.laz", utm, crs=f"EPSG:{_EPSG}")])
    near = f"--near={FRAME.latitude_deg!r},{FRAME.longitude_deg!r},80"
    words = ["anchor", database.url, joined.map_id, "--photos", str(tmp_path / "photos"), near, "--quiet"]
    assert main([*words, "--auto", "--out", str(tmp_path / "out")]) == 0
    assert "become map" in capsys.readouterr().out
    snapshot = Database.open(database.url).snapshot()
    placed = snapshot.load_map(joined.map_id)
    assert placed.status == "quarantined"
    (side,) = {image.image_id // 16 for image in placed.images}
    assert len(placed.images) >= 14
    truth = (OWN_FROM_LOCAL, JOIN @ OWN_FROM_LOCAL)[side].inverse()
    own = {image.name: image.cam_from_local.center for image in joined.images}
    to_here = FRAME.enu_from(placed.frame)
    for image in placed.images:
        there = to_here.act(image.cam_from_local.center)
        assert np.linalg.norm(there - truth.act(own[image.name])) < 0.5
    (rest,) = (snapshot.load_unplaced(m.map_id) for m in snapshot.unplaced_maps())
    assert rest.no_place.reason_code == "LEFT_OUT"
    assert {i.name for i in rest.images} | {i.name for i in placed.images} == set(own)
    assert len(rest.images) + len(placed.images) == len(own)
