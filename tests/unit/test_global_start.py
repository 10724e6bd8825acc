"""Which reconstructions are begun again with all photos at once."""

from dataclasses import replace
from pathlib import Path

import pytest

from featuredb.geometry.camera import Camera
from ingest.sfm import mapper as sfm
from ingest.sfm.mapper import SfmOptions, SfmTask, SfmView
from ingest.sfm.view_graph_focals import is_usual

_LENS = Camera.from_focal(854, 480, 577.0, "SIMPLE_RADIAL")


def _film(photos: int, *, known: bool = False) -> SfmTask:
    views = tuple(SfmView(name=f"{k}.jpg", camera_row=0, features=Path(f"{k}")) for k in range(photos))
    return SfmTask(cameras=((_LENS, known),), views=views, matches=(), options=SfmOptions())


def test_a_lens_that_ran_away_is_not_usual() -> None:
    assert is_usual(_LENS)
    for focal in (170.0, 8227.0):  # what a flight straight ahead came to from wrong starts
        assert not is_usual(replace(_LENS, params=(focal, *_LENS.params[1:])))


@pytest.mark.parametrize(
    ("task", "begun", "at_once", "kept"),
    [
        (_film(24), 0, 24, "at once"),
        (_film(24), 0, 0, "begun"),
        (_film(24), 23, 24, "begun"),  # not even tried
        (_film(24, known=True), 0, 24, "begun"),
        (_film(3), 0, 3, "begun"),  # photos of which each may have a lens of its own
    ],
)
def test_a_film_is_begun_again_where_its_lens_ran_away(
    task: SfmTask, begun: int, at_once: int, kept: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "models"
    output.mkdir()

    def write(folder: Path, name: str) -> None:
        (folder / "0").mkdir()
        (folder / "0" / "name").write_text(name)

    def begin(_database: Path, _images: Path, folder: Path, *_: object) -> frozenset[int]:
        write(folder, "begun")
        return frozenset(range(len(task.views)))

    def begin_with_all(_database: Path, _scratch: Path, folder: Path, **_: object) -> None:
        write(folder, "at once")

    found = {"begun": begun, "at once": at_once}
    monkeypatch.setattr(sfm, "run_incremental", begin)
    monkeypatch.setattr(sfm, "map_globally", begin_with_all)
    monkeypatch.setattr(
        sfm, "registered_with_usual_lens", lambda models, _: found[(models / "0" / "name").read_text()]
    )
    sfm._map(task, tmp_path / "colmap.db", tmp_path, output)
    assert (output / "0" / "name").read_text() == kept
