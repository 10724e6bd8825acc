"""A photo's own position as a weak prior: it settles what is ambiguous, and never moves an answer."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from featuredb.features.decode import probe
from featuredb.features.extractor import extract
from featuredb.maps.feature_map import FeatureMap
from reloc.localise import localise as module
from reloc.localise.candidates import IndexedArea
from reloc.localise.localise import Localised, localise, localise_features
from reloc.localise.options import LocaliseOptions
from reloc.localise.result import LocaliseRequest, LocaliseResult
from reloc.service.handler import localise_request
from reloc.wire.query import LocaliseWireRequest, RequestOptions
from tests.integration.test_localise import KNOWN, POSE, indexed, moved, pose_errors, prior_at
from tests.support import planar_map as field
from tests.support.planar_map import field_texture, render

OPTIONS = LocaliseOptions()
FAR_M = 3000.0


@pytest.fixture(scope="module")
def field_map() -> FeatureMap:
    return field.planar_map(map_id="field")


@pytest.fixture(scope="module")
def here(field_map: FeatureMap) -> IndexedArea:
    return indexed(field_map)


@pytest.fixture(scope="module")
def twin(field_map: FeatureMap) -> IndexedArea:
    return indexed(moved(field_map, "twin", FAR_M))


@pytest.fixture(scope="module")
def photo() -> NDArray[np.uint8]:
    return render(field_texture(1), POSE, seed=99)


def own(area: IndexedArea, east_m: float) -> LocaliseRequest:
    """The known camera, and a position that the photo claims."""
    return replace(KNOWN, own_position=prior_at(area, east_m))


def role(result: LocaliseResult) -> str | None:
    return None if result.own_position is None else result.own_position.role


@pytest.mark.parametrize("off_m", [0.0, 60.0])
def test_a_place_that_exists_twice_is_settled(
    here: IndexedArea, twin: IndexedArea, photo: NDArray[np.uint8], off_m: float
) -> None:
    """Also by the position of a phone between houses, which claims 5 m."""
    assert localise(photo, KNOWN, [here, twin]).reason == "AMBIGUOUS"
    result = localise(photo, own(here, off_m), [twin, here])
    assert pose_errors(result, POSE)[0] < 0.05
    assert role(result) == "decided"
    assert result.own_position is not None
    assert result.own_position.distance_m == pytest.approx(off_m, abs=0.3)
    assert localise(photo, own(here, 200.0), [twin, here]).reason == "AMBIGUOUS"


def test_a_photo_that_covers_half_the_field_with_something_else_is_settled(
    here: IndexedArea, photo: NDArray[np.uint8]
) -> None:
    covered = photo.copy()
    covered[:, :400] = np.random.default_rng(3).integers(0, 256, (480, 400), dtype=np.uint8)
    assert localise(covered, KNOWN, [here]).reason == "AMBIGUOUS"
    result = localise(covered, own(here, 10.0), [here])
    assert pose_errors(result, POSE)[0] < 0.1
    assert role(result) == "decided"
    elsewhere = localise(covered, own(here, 600_000.0), [here])
    assert (elsewhere.reason, role(elsewhere)) == ("AMBIGUOUS", "no_help")


@pytest.mark.parametrize("east_m", [300.0, FAR_M, 600_000.0])
def test_a_wrong_position_moves_no_answer(here: IndexedArea, photo: NDArray[np.uint8], east_m: float) -> None:
    """As near as the next street, in another town that has a map, and in another country."""
    town = indexed(moved(field.planar_map(5), "another town", FAR_M))
    plain, told = localise(photo, KNOWN, [here, town]), localise(photo, own(here, east_m), [here, town])
    assert pose_errors(told, POSE)[0] < 0.05
    assert role(told) == "contradicted"
    assert told.own_position is not None
    assert told.own_position.distance_m == pytest.approx(east_m, rel=0.01)
    assert plain.pose is not None
    assert told.pose is not None
    assert np.array_equal(plain.pose.utm, told.pose.utm)


def test_an_answer_that_agrees_is_the_same(here: IndexedArea, photo: NDArray[np.uint8]) -> None:
    plain, told = localise(photo, KNOWN, [here]), localise(photo, own(here, 8.0), [here])
    assert role(told) == "agrees"
    assert role(plain) is None
    assert plain.pose is not None
    assert told.pose is not None
    assert np.array_equal(plain.pose.utm, told.pose.utm)


def test_a_photo_of_nothing_that_the_maps_know_stays_refused(here: IndexedArea) -> None:
    other = render(field_texture(77), POSE, seed=3)
    result = localise(other, own(here, 0.0), [here])
    assert result.pose is None
    assert role(result) == "no_help"


def test_two_places_that_fit_are_ambiguous_and_not_the_positions_choice(
    here: IndexedArea, twin: IndexedArea, photo: NDArray[np.uint8]
) -> None:
    """The search everywhere finds one place alone; the photo claims the other, which fits as well."""
    features = extract(photo, OPTIONS.extractor)

    def near(request: LocaliseRequest) -> Localised:
        return localise_features(features, request, [twin])

    first = localise_features(features, KNOWN, [here])
    result = module._with_own_position(first, own(here, FAR_M), near, OPTIONS).result
    assert (result.reason, role(result)) == ("AMBIGUOUS", "contradicted")
    assert result.runner_up is not None
    assert result.runner_up.distance_m == pytest.approx(FAR_M, rel=2e-3)


def test_much_better_evidence_elsewhere_outweighs_the_position(
    here: IndexedArea, twin: IndexedArea, photo: NDArray[np.uint8]
) -> None:
    """Nothing was believed, but what was found elsewhere has twice the inliers."""
    features = extract(photo, OPTIONS.extractor)
    near = localise_features(features, replace(KNOWN, prior=prior_at(here, 0.0)), [here])
    refused = replace(
        near.result, reason="AMBIGUOUS", pose=None, confidence=0.0, inliers=2 * near.result.inliers
    )
    result = module._with_own_position(Localised(result=refused), own(here, 0.0), lambda _: near, OPTIONS)
    assert (result.result.reason, role(result.result)) == ("AMBIGUOUS", "no_help")


def test_a_prior_that_is_told_goes_before_it(here: IndexedArea, photo: NDArray[np.uint8]) -> None:
    result = localise(photo, replace(own(here, FAR_M), prior=prior_at(here, 0.0)), [here])
    assert result.reason is None
    assert result.own_position is None


def test_the_wire_asks_for_it(photo: NDArray[np.uint8]) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8825).update({1: "N", 2: (46.0, 30.0, 0.0), 3: "W", 4: (91.0, 45.0, 0.0)})
    file = BytesIO()
    Image.fromarray(photo).save(file, "JPEG", exif=exif)
    wants = LocaliseWireRequest(options=RequestOptions(exif_prior=True))
    asked = localise_request(wants, file.getvalue(), probe(file.getvalue()))
    assert asked.own_position is not None
    assert (asked.own_position.latitude_deg, asked.own_position.longitude_deg) == (46.5, -91.75)
    assert asked.prior is None
    assert (
        localise_request(LocaliseWireRequest(), file.getvalue(), probe(file.getvalue())).own_position is None
    )
