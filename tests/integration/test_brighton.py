"""Real drone photos through the whole line: ingest, server, client, against a map of all photos."""

from pathlib import Path

import pytest

from featuredb.store import Database
from tools.real_photos import ask, ingest, reference, table

pytestmark = [pytest.mark.real_data, pytest.mark.slow]

_HELD_OUT = ("DJI_0020.JPG", "DJI_0025.JPG", "DJI_0030.JPG", "DJI_0033.JPG")
_MAX_M, _MAX_DEG = 1.0, 0.5


def test_held_out_photos_lie_where_a_map_of_all_photos_has_them(shared_data: Path, tmp_path: Path) -> None:
    photos = shared_data / "brighton" / "images"
    if not photos.is_dir():
        pytest.skip(f"not there: {photos}")
    part = ingest(tmp_path / "part", photos, _HELD_OUT)
    whole = ingest(tmp_path / "whole", photos, ())
    assert (part.usable, part.registered) == (14, 14)
    assert (whole.usable, whole.registered) == (18, 18)

    database, truth = Database.open(tmp_path / "part"), reference(tmp_path / "whole")
    served = {
        i.name for m in database.snapshot().maps() for i in database.snapshot().load_map(m.map_id).images
    }
    assert served.isdisjoint(_HELD_OUT)
    rows = ask(database, photos, _HELD_OUT, truth)
    shown = table(rows, _MAX_M, _MAX_DEG)
    assert [row.name for row in rows] == list(_HELD_OUT)
    for row in rows:
        assert row.error is not None, shown
        assert row.error.position_m <= _MAX_M, shown
        assert row.error.angle_deg <= _MAX_DEG, shown
        # The map lends its lens to a photo of the same camera, and says how sure it is.
        assert row.camera == "map"
        assert 0.0 < row.horizontal_68_m < 10.0
        assert row.confidence > 0.5
