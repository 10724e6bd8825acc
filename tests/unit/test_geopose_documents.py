"""GeoPose documents: what the standard's compliance suite asks for, and no series of nothing."""

import jsonschema
import numpy as np
import pytest

from featuredb.geo.geopose import geopose_from_camera, irregular_series
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.rigid3 import Rigid3
from schemas import load_schema

_FRAME = LocalFrame(latitude_deg=48.0, longitude_deg=11.0, height_m=500.0)


def test_the_transition_model_of_a_series_is_an_object() -> None:
    pose = geopose_from_camera(Rigid3(rotation=np.eye(3), translation=np.zeros(3)), _FRAME)
    document = irregular_series([(1000, pose), (1040, pose)])
    assert document["header"]["transitionModel"] == {
        "authority": "/geopose/1.0",
        "id": "none",
        "parameters": "",
    }
    validator = jsonschema.Draft202012Validator(load_schema("geopose/irregular_series"))
    validator.validate(document)
    document["header"]["transitionModel"] = "none"  # as in drafts of the standard
    assert not validator.is_valid(document)


def test_a_series_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one pose"):
        irregular_series([])
