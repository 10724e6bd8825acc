"""Photos of a rendered field, localised in maps whose truth is known: errors in metres, and refusals."""

import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.errors import ImageError, IncompatibleExtractorError, InvalidValueError
from featuredb.features.extractor import ExtractorOptions, extract
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.maps.feature_map import FeatureMap, GeoPrior
from featuredb.maps.lens_uncertainty import LensUncertainty
from featuredb.stage_clock import StageClock
from reloc.localise import search
from reloc.localise.candidates import IndexedArea
from reloc.localise.localise import localise
from reloc.localise.options import LocaliseOptions
from reloc.localise.pose import PoseHypothesis
from reloc.localise.result import LocaliseRequest
from tests.support import planar_map as field
from tests.support.field_queries import KNOWN, POSE, indexed, moved, pose_errors
from tests.support.planar_map import CAMERA, EPSG, field_texture, render, view

UNSURE = LensUncertainty(
    focal_rel=0.003,
    aspect=0.001,
    center_rel=(2e-4, 2e-4),
    radial=(1e-4, 1e-4),
    tangential=(1e-5, 1e-5),
    dilution=50.0,
)


@pytest.fixture(scope="module")
def field_map() -> FeatureMap:
    return field.planar_map(map_id="field")


@pytest.fixture(scope="module")
def area(field_map: FeatureMap) -> IndexedArea:
    return indexed(field_map)


@pytest.fixture(scope="module")
def texture() -> NDArray[np.uint8]:
    return field_texture(1)


@pytest.fixture(scope="module")
def photo(texture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return render(texture, POSE, seed=99)


@pytest.mark.parametrize(
    "truth",
    [POSE, view(-8, 9, 35, 0, 0), view(0, 0, 55, 20, 250), view(10, 10, 42, 15, 120)],
)
def test_a_known_camera_within_centimetres(
    area: IndexedArea, texture: NDArray[np.uint8], truth: Rigid3
) -> None:
    result = localise(render(texture, truth, seed=5), KNOWN, [area])
    position_m, angle_deg = pose_errors(result, truth)
    assert position_m < 0.05
    assert angle_deg < 0.05
    assert result.reason is None
    assert result.confidence > 0.95
    assert result.inliers > 200
    pose = result.pose
    assert pose is not None
    np.testing.assert_allclose(pose.utm, area.area.frame.utm_from_enu(truth.center, EPSG), atol=0.05)
    assert pose.camera_source == "request"
    assert pose.horizontal_68_m < 0.1


def test_a_camera_told_as_exact_is_as_sure_as_the_lenses_of_the_map(
    field_map: FeatureMap, texture: NDArray[np.uint8]
) -> None:
    """From above a lens that is 0.3 % off passes for a height that is."""
    truth = view(0, 0, 45, 10, 20)
    knows = replace(field_map, provenance=field_map.provenance | UNSURE.as_provenance())
    photo, exact = render(texture, truth, seed=5), replace(KNOWN, camera_is_exact=True)
    plain, told = (localise(photo, exact, [indexed(one)]) for one in (field_map, knows))
    assert plain.pose is not None
    assert told.pose is not None
    assert told.pose.camera == CAMERA  # as it was told
    assert pose_errors(told, truth)[0] < 0.2
    # 0.3 % of 45 m, and not the centimetres that the pixels alone tell.
    assert plain.pose.vertical_68_m < 0.05
    assert 0.1 < told.pose.vertical_68_m < 0.3
    # What is lent by a map goes with that map's points.
    lent = localise(photo, KNOWN, [indexed(knows)])
    assert lent.pose is not None
    assert lent.pose.vertical_68_m == pytest.approx(plain.pose.vertical_68_m)


def test_a_camera_told_as_exact_that_made_the_map_goes_with_its_points(
    field_map: FeatureMap, texture: NDArray[np.uint8]
) -> None:
    """A map whose lens is 1 % too long has its ground 1 % too deep, for photos of its camera, too."""
    truth = view(0, 0, 45, 10, 20)
    longer = replace(CAMERA, params=(*(1.01 * f for f in CAMERA.params[:2]), *CAMERA.params[2:]))
    provenance = field_map.provenance | replace(UNSURE, focal_rel=0.005).as_provenance()
    made = replace(field_map, cameras=(longer,), camera_keys=("DJI",), provenance=provenance)
    photo, exact = render(texture, truth, seed=5), replace(KNOWN, camera_is_exact=True)
    heights = {}
    for name, request in {
        "of another camera": exact,
        "of the map's": replace(exact, camera_key="DJI"),
        "far from the map's": replace(
            exact,
            camera_key="DJI",
            camera=replace(CAMERA, params=(longer.params[0] * 0.96,) * 2 + CAMERA.params[2:]),
        ),
    }.items():
        pose = localise(photo, request, [indexed(made)]).pose
        assert pose is not None
        assert pose.camera == request.camera
        heights[name] = float(pose.cam_from_local.center[2] - truth.center[2])
    assert heights["of another camera"] == pytest.approx(0.0, abs=0.2)
    assert heights["of the map's"] == pytest.approx(0.01 * 45.0, abs=0.05)
    assert heights["far from the map's"] == pytest.approx(-0.03 * 45.0, abs=0.2)


def test_a_map_lends_a_lens_of_fewer_parameters_than_its_uncertainty(
    field_map: FeatureMap, texture: NDArray[np.uint8]
) -> None:
    truth = view(0, 0, 45, 10, 20)
    assert CAMERA.model == "PINHOLE"
    provenance = field_map.provenance | UNSURE.as_provenance()
    made = replace(field_map, camera_keys=("DJI",), provenance=provenance)
    asked = replace(KNOWN, camera=None, camera_key="DJI")
    pose = localise(render(texture, truth, seed=5), asked, [indexed(made)]).pose
    assert pose is not None
    assert pose.camera_source == "map"


@pytest.mark.parametrize("tilt_deg", [45.0, 55.0])
def test_a_view_far_aside_from_those_of_the_map(
    area: IndexedArea, texture: NDArray[np.uint8], tilt_deg: float
) -> None:
    """The map looks down, at most 15 degrees aside; from 40 degrees farther SIFT finds hundreds of points."""
    truth = view(0.0, -40.0 * np.tan(np.radians(tilt_deg)), 40.0, tilt_deg, 0.0)
    result = localise(render(texture, truth, seed=3), KNOWN, [area])
    position_m, angle_deg = pose_errors(result, truth)
    assert position_m < 0.1
    assert angle_deg < 0.1
    assert result.inliers > 200


@pytest.mark.parametrize(
    "request_", [LocaliseRequest(), LocaliseRequest(exif_focal_px=560.0)], ids=["unknown", "exif"]
)
@pytest.mark.parametrize("kind", ["plain", "upside down", "zoomed", "blurred"])
def test_an_unknown_lens_over_a_flat_field(
    area: IndexedArea, photo: NDArray[np.uint8], request_: LocaliseRequest, kind: str
) -> None:
    """Flat and nearly from above: the error may be metres in height, and the answer says so."""
    image, truth, focal = photo, POSE, 600.0
    if kind == "upside down":
        image = photo[::-1, ::-1]
        truth = Rigid3.exp([0, 0, np.pi, 0, 0, 0]) @ POSE
    elif kind == "zoomed":
        if request_.exif_focal_px:
            request_ = replace(request_, exif_focal_px=2 * request_.exif_focal_px)
        image, focal = cv2.resize(photo[120:360, 160:480], (640, 480), interpolation=cv2.INTER_CUBIC), 1200.0
    elif kind == "blurred":
        image = cv2.GaussianBlur(photo, (0, 0), 2.0)
    result = localise(np.ascontiguousarray(image), request_, [area])
    pose_m, angle_deg = pose_errors(result, truth)
    pose = result.pose
    assert pose is not None
    allowed_m = 3.0 * np.hypot(pose.horizontal_68_m, pose.vertical_68_m)
    assert pose_m < max(allowed_m, 0.05)
    assert angle_deg < max(3.0 * pose.orientation_68_deg, 0.05)
    assert pose.vertical_68_m < 6.0
    assert pose.camera.focal_px == pytest.approx(focal, rel=0.2)
    assert pose.camera_source == ("exif" if request_.exif_focal_px else "estimated")


def test_the_camera_of_the_map_is_borrowed_by_its_key(
    field_map: FeatureMap, photo: NDArray[np.uint8]
) -> None:
    area = indexed(replace(field_map, camera_keys=("DJI",)))
    result = localise(photo, LocaliseRequest(camera_key="DJI", exif_focal_px=400.0), [area])
    assert result.pose is not None
    assert (result.pose.camera, result.pose.camera_source) == (CAMERA, "map")
    assert pose_errors(result, POSE)[0] < 0.05
    # Frames of a film are the same picture, made smaller.
    half = cv2.resize(photo, (320, 240), interpolation=cv2.INTER_AREA)
    smaller = localise(half, LocaliseRequest(camera_key="DJI", exif_focal_px=400.0), [area])
    assert smaller.pose is not None
    assert (smaller.pose.camera, smaller.pose.camera_source) == (CAMERA.scaled_to(320, 240), "map")
    # Of another shape it is another picture; so is another key.
    for image, key in ((photo[:360], "DJI"), (photo, "GoPro")):
        result = localise(image, LocaliseRequest(camera_key=key), [area])
        assert result.pose is None or result.pose.camera_source == "estimated"


@pytest.mark.parametrize("request_", [KNOWN, LocaliseRequest()], ids=["known", "unknown"])
@pytest.mark.parametrize("kind", ["mirrored", "flipped", "other field", "noise", "negative"])
def test_what_is_no_photo_of_the_field_is_refused(
    area: IndexedArea, photo: NDArray[np.uint8], kind: str, request_: LocaliseRequest
) -> None:
    image = {
        "mirrored": photo[:, ::-1],
        "flipped": photo[::-1],
        "other field": render(field_texture(77), POSE, seed=3),
        "noise": np.random.default_rng(0).integers(0, 256, photo.shape, dtype=np.uint8),
        "negative": 255 - photo,
    }[kind]
    result = localise(np.ascontiguousarray(image), request_, [area])
    assert result.pose is None
    assert result.reason in ("TOO_FEW_INLIERS", "TOO_FEW_MATCHES")
    assert result.confidence == 0.0


@pytest.mark.parametrize("request_", [KNOWN, LocaliseRequest()], ids=["known", "unknown"])
@pytest.mark.evaluation
def test_giving_up_early_changes_no_answer(
    area: IndexedArea,
    photo: NDArray[np.uint8],
    request_: LocaliseRequest,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """From a photo that is easily found to one that is not: the answers of a search that never gives up."""
    asked: list[bool] = []

    def counted(matches: int, pose: PoseHypothesis, options: LocaliseOptions) -> bool:
        asked.append(is_hopeless(matches, pose, options))
        return asked[-1]

    is_hopeless = search._is_hopeless
    other = render(field_texture(77), POSE, seed=3).astype(np.float64)
    images = [np.round((1 - w) * photo + w * other).astype(np.uint8) for w in np.linspace(0.3, 0.7, 9)]
    monkeypatch.setattr(search, "_is_hopeless", counted)
    early = [localise(image, request_, [area]) for image in images]
    monkeypatch.setattr(search, "_is_hopeless", lambda *_: False)
    late = [localise(image, request_, [area]) for image in images]
    assert {result.pose is None for result in early} == {True, False}
    assert any(asked)
    for a, b in zip(early, late, strict=True):
        assert a.reason == b.reason
        assert (a.pose is None) == (b.pose is None)
        if a.pose is not None and b.pose is not None:
            assert np.array_equal(a.pose.utm, b.pose.utm)


def test_a_smaller_copy_gives_the_pose_in_pixels_of_the_photo(
    area: IndexedArea, photo: NDArray[np.uint8]
) -> None:
    small = np.asarray(cv2.resize(photo, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    found = localise(small, KNOWN, [area], size=(photo.shape[1], photo.shape[0]))
    assert found.pose is not None
    metres, degrees = pose_errors(found, POSE)
    assert max(metres, degrees) < 0.2


def test_a_blank_photo_has_too_few_features(area: IndexedArea) -> None:
    result = localise(np.full((480, 640), 90, np.uint8), KNOWN, [area])
    assert result.reason == "TOO_FEW_FEATURES"
    assert (result.features, result.matches, result.inliers) == (0, 0, 0)


def test_no_maps_and_a_prior_far_away_are_no_coverage(area: IndexedArea, photo: NDArray[np.uint8]) -> None:
    nothing = localise(photo, KNOWN, [])
    assert (nothing.reason, nothing.detail) == ("NO_COVERAGE", "no map is active")
    far = localise(photo, replace(KNOWN, prior=prior_at(area, 5000.0)), [area])
    assert (far.reason, far.detail) == ("NO_COVERAGE", "no map lies within reach of the prior")


def prior_at(area: IndexedArea, east_m: float) -> GeoPrior:
    lat, lon, _ = area.area.frame.geodetic_from_enu(POSE.center + np.array([east_m, 0.0, 0.0]))
    return GeoPrior(
        latitude_deg=float(lat),
        longitude_deg=float(lon),
        height_m=None,
        sigma_horizontal_m=5.0,
        sigma_vertical_m=10.0,
    )


@pytest.mark.parametrize(("east_m", "reason"), [(0.0, None), (15.0, None), (40.0, "CONTRADICTS_PRIOR")])
def test_a_prior_is_held_against_the_pose(
    area: IndexedArea, photo: NDArray[np.uint8], east_m: float, reason: str | None
) -> None:
    result = localise(photo, replace(KNOWN, prior=prior_at(area, east_m)), [area])
    assert result.reason == reason
    assert (result.pose is None) == (reason is not None)
    assert result.inliers > 200  # the evidence is told either way


def test_another_pose_of_a_photo_knows_as_little_of_its_lens(
    area: IndexedArea, texture: NDArray[np.uint8], photo: NDArray[np.uint8]
) -> None:
    """A picture of two views: what is left over by one has a lens that was estimated all the same."""
    both = photo.copy()
    both[:, :320] = render(texture, view(-9, 8, 45, 10, 200), seed=7)[:, :320]
    options = LocaliseOptions()
    features = extract(both, options.extractor)
    unknown = LocaliseRequest(exif_focal_px=600.0)
    candidates, _, refusal = search.search(features, unknown, [area], options, StageClock())
    assert refusal is None
    poses = [one.pose for one in candidates if one.evidence.inliers > 50]
    assert len(poses) == 2
    for pose in poses:
        assert pose.camera_source == "exif"
        assert pose.lens_prior is not None


@pytest.mark.parametrize("apart_m", [150.0, 3000.0])
@pytest.mark.parametrize("one_area", [True, False])
def test_a_place_that_exists_twice_is_ambiguous(
    field_map: FeatureMap, photo: NDArray[np.uint8], apart_m: float, one_area: bool
) -> None:
    twin = moved(field_map, "twin", apart_m)
    areas = [indexed(field_map, twin)] if one_area else [indexed(field_map), indexed(twin)]
    for order in (areas, areas[::-1]):
        result = localise(photo, KNOWN, order)
        assert result.reason == "AMBIGUOUS"
        assert result.runner_up is not None
        assert result.runner_up.distance_m == pytest.approx(apart_m, rel=2e-3)
        assert result.runner_up.inliers > 200
    # A prior tells them apart where they are far enough from each other.
    if apart_m > 1000:
        told = localise(photo, replace(KNOWN, prior=prior_at(indexed(field_map), 0.0)), areas)
        assert told.reason is None
        assert pose_errors(told, POSE)[0] < 0.05


@pytest.mark.parametrize(("sigma_m", "reason"), [(2.0, None), (0.01, "AMBIGUOUS")])
def test_two_maps_of_one_place_that_gps_put_metres_apart(
    field_map: FeatureMap, photo: NDArray[np.uint8], sigma_m: float, reason: str | None
) -> None:
    """With honest uncertainties they are one place; were they exact, they would be two."""
    maps = moved(field_map, "one", 0.0, sigma_m), moved(field_map, "two", 4.0, sigma_m)
    result = localise(photo, KNOWN, [indexed(*maps)])
    assert result.reason == reason
    if reason is None:
        position_m, angle_deg = pose_errors(result, POSE)
        assert min(position_m, abs(position_m - 4.0)) < 0.05
        assert angle_deg < 0.05
        assert result.pose is not None
        assert result.pose.horizontal_68_m == pytest.approx(1.51 * sigma_m, rel=0.05)


def half_turned(texture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return ((texture.astype(int) + texture[::-1, ::-1]) // 2).astype(np.uint8)


def periodic(texture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A pattern that comes back every 12 m."""
    return np.tile(texture[:150, :150], (10, 10))


@pytest.mark.parametrize("pattern", [half_turned, periodic])
@pytest.mark.parametrize("request_", [KNOWN, LocaliseRequest()], ids=["known", "unknown"])
def test_a_pattern_that_fits_itself_is_never_answered_wrongly(
    monkeypatch: pytest.MonkeyPatch, texture: NDArray[np.uint8], pattern: object, request_: LocaliseRequest
) -> None:
    made = pattern(texture)  # type: ignore[operator]
    monkeypatch.setattr(field, "field_texture", lambda seed: made)
    area = indexed(field.planar_map())
    result = localise(render(made, POSE, seed=9), request_, [area])
    assert result.reason == "AMBIGUOUS"


def test_what_cannot_be_compared_or_used_raises(area: IndexedArea, photo: NDArray[np.uint8]) -> None:
    upright = LocaliseOptions(extractor=ExtractorOptions(upright=True))
    with pytest.raises(IncompatibleExtractorError, match="again with this version"):
        localise(photo, KNOWN, [area], upright)
    for image in (np.zeros((1, 3000), np.uint8), photo.astype(np.float32), np.zeros((480, 640, 3), np.uint8)):
        with pytest.raises(ImageError):
            localise(image, KNOWN, [area])
    other = Camera(model="PINHOLE", width=1280, height=960, params=(1200.0, 1200.0, 640.0, 480.0))
    with pytest.raises(InvalidValueError, match="scaled_to"):
        localise(photo, LocaliseRequest(camera=other), [area])


def test_the_timings_add_up_and_the_inliers_reproject(area: IndexedArea, photo: NDArray[np.uint8]) -> None:
    before = time.perf_counter()
    result = localise(photo, replace(KNOWN, want_inliers=True), [area], snapshot=7)
    wall_ms = 1000 * (time.perf_counter() - before)
    assert result.snapshot == 7
    assert next(iter(result.timings_ms)) == "features"
    assert 0.95 * wall_ms - 10.0 < result.timings_ms["total"] <= wall_ms
    assert result.pose is not None
    inliers = result.pose.inliers
    assert inliers is not None
    local = area.area.frame.enu_from_utm(np.array(inliers.utm), EPSG)
    gap = np.linalg.norm(CAMERA.project(POSE.act(local)) - np.array(inliers.pixels), axis=1)
    assert len(gap) == result.inliers
    assert np.median(gap) < 0.5
    assert gap.max() < 3.0
