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
        _photo(owner="ann", make="DJI", model="FC300", film="b.mp4"),  # her drone's films are no other drones
        _photo(contributor="eve", owner="f", make="g"),
        _photo(contributor="eve", owner="h", make="i"),  # who contributed is known, the rest is only said
    ]
    assert whose_cameras(photos).tolist() == [0, 0, 1, 2, 3, 2, 4, 4, 0, 5, 5]


def test_photos_that_name_nothing_are_by_one_camera_where_their_focal_lengths_agree() -> None:
    """A program that takes the distortion off leaves pictures of different sizes."""
    photos = [_photo(width=1000 + k, height=750) for k in range(6)]
    assert len(set(whose_cameras(photos, [800.0, 810.0, 790.0, 805.0, 802.0, 900.0]).tolist())) == 1
    assert len(set(whose_cameras(photos, [800.0, 1210.0, 590.0, 2005.0, 702.0, 1500.0]).tolist())) == 6


def test_no_photos_have_no_cameras() -> None:
    assert len(whose_cameras([])) == 0
