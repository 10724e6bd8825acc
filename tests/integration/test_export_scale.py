"""The program that measures the export of a large database, at a small size."""

from pathlib import Path

import numpy as np
import pytest

from featuredb.store import Database
from featuredb.store.verify import verify
from tools import export_scale


def arguments(out: Path, *more: str) -> list[str]:
    return ["--out", str(out), "--points", "2500", "--map-points", "1000", *more]


def test_it_makes_exports_measures_and_compares(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert export_scale.main(arguments(tmp_path, "--check")) == 0
    out = capfd.readouterr().out
    assert "3 maps, 6 images, " in out
    assert "read back: 3 of 3 maps the same" in out
    assert "under 2 wanted: holds" in out
    database = Database.open(tmp_path / "db-2500-1000-0")
    assert [m.points for m in database.snapshot().maps()] == [1000, 1000, 500]
    assert verify(database).ok
    with pytest.raises(SystemExit, match="found a dataset; remove it"):
        export_scale.main(arguments(tmp_path))
    (tmp_path / "dataset").rename(tmp_path / "first")
    monkeypatch.setattr(export_scale, "_PEAK_GIB", 0.01)
    assert export_scale.main(arguments(tmp_path)) == 1
    assert "under 0.01 wanted: FAILS" in capfd.readouterr().out
    assert (tmp_path / "first/points/32632-egm2008-0000.parquet").read_bytes() == (
        tmp_path / "dataset/points/32632-egm2008-0000.parquet"
    ).read_bytes()


def test_the_maps_have_the_statistics_that_are_named() -> None:
    feature_map = export_scale.simulated_map(3, 20_000, seed=1)
    seen = feature_map.observations
    assert len(seen) / len(feature_map.points) == pytest.approx(3.7, abs=0.05)
    assert seen.has_descriptor.mean() == pytest.approx(0.75, abs=0.02)
    assert len(feature_map.images) == 21
    np.testing.assert_array_equal(np.bincount(seen.point_index), feature_map.points.track_length)
