"""What photos say of who took them and with what."""

from pathlib import Path

from ingest.photos.photo import Photo, whose_cameras


def _photo(**said: object) -> Photo:
    return Photo(name="a.jpg", path=Path("a.jpg"), **{"width": 1024, "height": 768} | said)  # type: ignore[arg-type]


def test_cameras_are_told_apart_by_who_took_the_photo_by_make_and_model_and_else_by_size() -> None:
    photos = [
        _photo(owner="ann", make="DJI", model="FC300", camera_key="DJI|FC300|20"),
        _photo(owner="ann", make="DJI", model="FC300", camera_key="DJI|FC300|24"),  # a zoom is no other hand
        _photo(owner="ben", make="DJI", model="FC300"),
        _photo(),
        _photo(width=1024, height=681),
        _photo(),
        _photo(film="a.mp4"),
        _photo(film="a.mp4", height=681),
    ]
    assert whose_cameras(photos).tolist() == [0, 0, 1, 2, 3, 2, 4, 4]


def test_no_photos_have_no_cameras() -> None:
    assert len(whose_cameras([])) == 0
