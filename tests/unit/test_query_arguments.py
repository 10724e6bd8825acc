"""A query's camera as text, there and back."""

import pytest

from featuredb.errors import InvalidValueError
from reloc.cli.query_arguments import as_arguments, parse_camera
from reloc.wire.query import CameraRequest

CAMERA = CameraRequest(
    model="SIMPLE_RADIAL",
    width=640,
    height=480,
    params=(600.5, 320.0, 240.0, -0.03),
    sigmas=(0.5, 0.25, 0.25, 0.001),
)


@pytest.mark.parametrize("camera", [CAMERA, CAMERA.model_copy(update={"sigmas": None})])
def test_a_camera_is_the_same_after_it_was_written_and_read(camera: CameraRequest) -> None:
    words = dict(word.lstrip("-").split("=") for word in as_arguments(camera).split())
    assert parse_camera(words["camera"], words.get("camera-sigmas")) == camera


@pytest.mark.parametrize(
    "sigmas", ["", "1,2,3", "1,2,3,x", "1,2,3,-4", "1,2,3,nan", "1,2,3,inf", "1,2,3,4,5"]
)
def test_sigmas_that_are_none_are_refused(sigmas: str) -> None:
    with pytest.raises(InvalidValueError, match="expected 4 numbers"):
        parse_camera("SIMPLE_RADIAL,640,480,600,320,240,0", sigmas)


def test_sigmas_without_a_camera_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="--camera"):
        parse_camera(None, "1,2,3,4")
    assert parse_camera(None) is None
