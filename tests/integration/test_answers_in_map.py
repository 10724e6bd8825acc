"""Answers of a map without a place: right in its own frame, and never to be taken for a place on Earth."""

import json
from dataclasses import replace

import jsonschema
import numpy as np
import pytest
from pydantic import ValidationError

from featuredb.errors import MapNotFoundError, UnplacedBesideOthersError
from featuredb.geometry.camera import Camera
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.error_modes import LENS_SIZE, ErrorModes
from featuredb.maps.unplaced_map import NoPlace, OwnFrame, OwnPoints, UnplacedMap
from featuredb.store import Database
from reloc.gateway.geopose import GeoPoseReq, NotLocalisedError, response_of
from reloc.localise.result import LocaliseRequest
from reloc.localiser import Localiser
from reloc.service.handler import reply_from_result
from reloc.wire.query import LocaliseReply
from reloc.wording import describe
from schemas import load_schema
from tests.support.planar_map import CAMERA, field_texture, planar_map, render, view

# The own frame is turned, three times as large and shifted against the field.
OWN_FROM_FIELD = Sim3(scale=3.0, rotation=so3_exp([0.4, -0.2, 1.1]), translation=np.array([7.0, -5.0, 2.0]))
POSE = view(3, 2, 40, 10, 30)


def _without_place() -> UnplacedMap:
    placed = planar_map(map_id="adrift")
    return UnplacedMap(
        map_id="adrift",
        name="film",
        frame=OwnFrame(metric=False, upright=False),
        cameras=placed.cameras,
        images=tuple(
            replace(i, cam_from_local=OWN_FROM_FIELD.act_on_pose(i.cam_from_local)) for i in placed.images
        ),
        points=OwnPoints(
            xyz=OWN_FROM_FIELD.act(placed.points_local()),
            **placed.points.columns(np.arange(len(placed.points))),
        ),
        observations=placed.observations,
        no_place=NoPlace(reason_code="TOO_FEW", reason="no photo has GPS"),
        extractor_fingerprint=placed.extractor_fingerprint,
    )


def _that_may_be_bent() -> UnplacedMap:
    """The same, whose images may all be off by half a percent of their distance, forth or back."""
    made = _without_place()
    poses = np.zeros((len(made.images), 6, 1))
    poses[:, 5] = 5e-3
    modes = ErrorModes(
        image_id=np.array([image.image_id for image in made.images]),
        poses=poses,
        lenses=np.zeros((len(made.cameras), LENS_SIZE, 1)),
    )
    lens = Camera(
        model="OPENCV", width=CAMERA.width, height=CAMERA.height, params=(*CAMERA.params, 0.0, 0.0, 0.0, 0.0)
    )
    return replace(made, map_id="bent", provenance=modes.as_provenance(), cameras=(lens,) * len(made.cameras))


@pytest.fixture(scope="module")
def localiser(tmp_path_factory: pytest.TempPathFactory) -> Localiser:
    database = Database.create(tmp_path_factory.mktemp("adrift") / "db")
    database.commit_maps([_without_place(), _that_may_be_bent(), planar_map(texture_seed=2, map_id="placed")])
    return Localiser.open(database)


@pytest.fixture(scope="module")
def reply(localiser: Localiser) -> LocaliseReply:
    request = LocaliseRequest(camera=CAMERA, map_ids=("adrift",), want_inliers=True)
    result = localiser.localise(render(field_texture(1), POSE, seed=5), request)
    assert result.status == "localised_in_map"
    assert result.pose is None
    return reply_from_result(result, request_id="r1", timings_ms={"total": 1.0})


def test_the_pose_is_right_in_the_maps_own_frame(reply: LocaliseReply) -> None:
    assert reply.in_map is not None
    truth = OWN_FROM_FIELD.act_on_pose(POSE)
    assert (
        np.linalg.norm(np.array(reply.in_map.center) - truth.center) < 3.0 * 0.1
    )  # a decimetre of the field
    sigma = np.sqrt(np.trace(np.array(reply.in_map.covariance)[3:, 3:]))
    assert np.linalg.norm(np.array(reply.in_map.center) - truth.center) < 5.0 * sigma


def test_what_the_map_may_be_off_by_is_in_the_answer(localiser: Localiser) -> None:
    photo = render(field_texture(1), POSE, seed=5)
    variance = {}
    for map_id in ("adrift", "bent"):
        found = localiser.localise(photo, LocaliseRequest(camera=CAMERA, map_ids=(map_id,))).in_map
        assert found is not None
        variance[map_id] = float(np.trace(np.array(found.covariance)[3:, 3:]))
    distance = 3.0 * 40.0  # of the camera above the field, in the own frame
    assert variance["bent"] - variance["adrift"] == pytest.approx((5e-3 * distance) ** 2, rel=0.3)


def test_only_the_query_that_names_it_is_answered_by_it(localiser: Localiser) -> None:
    photo = render(field_texture(1), POSE, seed=5)
    unnamed = localiser.localise(photo, LocaliseRequest(camera=CAMERA))
    assert unnamed.status == "not_localised"
    with pytest.raises(UnplacedBesideOthersError, match="named alone"):
        localiser.localise(photo, LocaliseRequest(camera=CAMERA, map_ids=("adrift", "placed")))
    with pytest.raises(MapNotFoundError):
        localiser.localise(photo, LocaliseRequest(camera=CAMERA, map_ids=("nothing",)))
    refused = localiser.localise(
        render(field_texture(9), POSE), LocaliseRequest(camera=CAMERA, map_ids=("adrift",))
    )
    assert refused.status == "not_localised"
    assert refused.runner_up is None


def test_schema_and_client_type_keep_it_apart_from_a_place(reply: LocaliseReply) -> None:
    document = json.loads(reply.model_dump_json())
    validator = jsonschema.Draft202012Validator(load_schema("wire/localise_reply"))
    validator.validate(document)
    for place in ("position", "quaternion", "utm", "accuracy", "covariance", "height_datum", "runner_up"):
        assert document[place] is None
    position = {"lat": 0.0, "lon": 3.0, "h": 0.0}
    for wrong in (
        {"status": "localised"},
        {"status": "not_localised"},
        {"position": position},
        {"in_map": None},
        {"height_datum": "unknown"},
    ):
        assert not validator.is_valid({**document, **wrong}), wrong
        with pytest.raises(ValidationError):
            LocaliseReply.model_validate_json(json.dumps({**document, **wrong}))


def test_the_text_says_that_it_is_no_place(reply: LocaliseReply) -> None:
    said = describe("photo.jpg", reply, "town.db")
    assert "of town.db, which has NO PLACE ON EARTH" in said
    assert "not metres" in said
    assert "UTM" not in said
    assert "WGS84" not in said


def test_the_gateway_gives_no_geopose_for_it(reply: LocaliseReply) -> None:
    request = GeoPoseReq.model_construct(id="phone-1", timestamp=0)
    with pytest.raises(NotLocalisedError, match=r"found in map adrift, which has no place on Earth"):
        response_of(request, reply)
