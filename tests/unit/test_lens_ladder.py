"""What tells a lens that was measured from one that was traded against tilt or the scene's shape."""

import pytest

from featuredb.geometry.camera import Camera
from ingest.lens_ladder import aspect_rel


@pytest.mark.parametrize(
    ("focals", "rel"), [((577.0, 577.0), 0.0), ((224.0, 168.0), 0.3333), ((168.0, 224.0), 0.3333)]
)
def test_focal_lengths_that_differ_are_told(focals: tuple[float, float], rel: float) -> None:
    lens = Camera(model="OPENCV", width=854, height=480, params=(*focals, 427.0, 240.0, 0.0, 0.0, 0.0, 0.0))
    assert aspect_rel(lens) == pytest.approx(rel, abs=1e-4)
