"""The town's layout, its sensors and plans: values against closed forms."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from PIL import ExifTags

from featuredb.errors import InvalidValueError
from featuredb.geo.utm import meridian_convergence_deg
from featuredb.simworld.camera.photograph import SensorOptions, exif_of, expose, moving_cars
from featuredb.simworld.flight import (
    FlightOptions,
    drone_device,
    pedestrians,
    survey,
    survey_half_extent,
    visitors,
)
from featuredb.simworld.town.materials import FACADE_LENGTH_M, town_textures, water_texture
from featuredb.simworld.town.scene import Faces, Scene
from featuredb.simworld.town.texture import Texture, fractal, periodic
from featuredb.simworld.town.town import OTHER_TOWN_PLACE, TOWN_PLACE, make_town

SIZE = (200.0, 180.0)


@pytest.fixture(scope="module")
def town() -> Scene:
    return make_town(1, size_m=SIZE)


def test_the_same_seed_gives_the_same_town_and_another_seed_another(town: Scene) -> None:
    again, other = make_town(1, size_m=SIZE), make_town(2, size_m=SIZE)
    for name in Faces.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(town.faces, name), getattr(again.faces, name))
    np.testing.assert_array_equal(town.ellipsoids.center, again.ellipsoids.center)
    assert town.plan == again.plan
    assert town.plan.buildings != other.plan.buildings


def test_both_towns_lie_where_convergence_matters() -> None:
    for latitude, longitude, _, epsg in (TOWN_PLACE, OTHER_TOWN_PLACE):
        assert abs(meridian_convergence_deg(latitude, longitude, epsg)) > 0.7


def test_terraced_houses_are_exactly_alike(town: Scene) -> None:
    looks = [
        (b.facade, b.facade_u, b.detail_u, b.roof, b.roof_u, b.width, b.depth, b.tint)
        for b in town.plan.buildings
    ]
    most = max(looks.count(look) for look in looks)
    assert most >= 8
    # Alike in texture coordinates too, and not only in the plan.
    walls = town.faces.uv[(town.faces.object_id >= 10_000) & (town.faces.object_id < 20_000)]
    _, counts = np.unique(np.round(walls[:, [0, 2]], 9), axis=0, return_counts=True)
    assert counts.max() >= most


def test_buildings_of_several_pieces_stand_where_they_stood_and_only_identical_ones_share_a_look(
    town: Scene,
) -> None:
    varied = make_town(1, size_m=SIZE, pieces=3)
    np.testing.assert_array_equal(varied.faces.origin, town.faces.origin)
    np.testing.assert_array_equal(varied.faces.texture, town.faces.texture)
    np.testing.assert_array_equal(varied.ellipsoids.center, town.ellipsoids.center)

    def looks(scene: Scene) -> list[tuple[float, float, float]]:
        return [(b.facade_u, b.detail_u, b.roof_u) for b in scene.plan.buildings]

    before, after = looks(town), looks(varied)
    alike = [[a == b for b in before] for a in before]
    assert [[a == b for b in after] for a in after] == alike
    apart = {round((b[0] - a[0]) / FACADE_LENGTH_M) for a, b in zip(before, after, strict=True)}
    assert apart == {0, 1, 2}
    # The back of a house is another piece than its front.
    fronts = varied.faces.uv[varied.faces.object_id == 10_000][:4, 0]
    assert fronts[2] - fronts[0] == pytest.approx(FACADE_LENGTH_M)


@pytest.mark.evaluation
def test_walls_in_pieces_have_one_design_and_no_piece_twice() -> None:
    (one,), (three,) = (
        [t for name, t in town_textures(5, pieces).items() if name == "facade_brick"] for pieces in (1, 3)
    )
    first, second, third = np.split(three.levels[0].astype(float), 3, axis=1)
    np.testing.assert_array_equal(first, one.levels[0])
    for a, b in ((first, second), (first, third), (second, third)):
        assert np.corrcoef(a[..., 0].ravel(), b[..., 0].ravel())[0, 1] < 0.95
        assert np.abs(a - b).mean() > 5.0


def test_solids_look_outward(town: Scene) -> None:
    """Signed volume of each building by the divergence theorem; the open underside lies below ground."""
    for i, b in enumerate(town.plan.buildings[:20]):
        mine = town.faces.object_id == 10_000 + i
        origin = town.enu_from_town @ np.array([b.x, b.y, b.base])
        area = (
            np.cross(town.faces.edge_s[mine], town.faces.edge_t[mine])
            * np.where(town.faces.triangle[mine], 0.5, 1.0)[:, None]
        )
        volume = np.einsum("ij,ij->", town.faces.origin[mine] - origin, area) / 3.0
        walls, roof = b.eaves - b.base, 0.5 * b.ridge
        chimney = (0.7**2) * (0.6 * b.ridge + 0.8) if b.ridge > 0 else 0.0
        # The chimney's own underside is open, too: its lever arm is the height of its base.
        chimney += 0.7**2 * (b.eaves + 0.4 * b.ridge - b.base) / 3.0 * (b.ridge > 0)
        assert volume == pytest.approx(b.width * b.depth * (walls + roof) + chimney, rel=1e-6)


def test_a_town_too_small_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="150 m"):
        make_town(1, size_m=(100.0, 300.0))


def test_cars_and_waves_differ_from_moment_to_moment(town: Scene) -> None:
    first, again, later = moving_cars(town, 1), moving_cars(town, 1), moving_cars(town, 2)
    np.testing.assert_array_equal(first.origin, again.origin)
    assert first.origin.shape != later.origin.shape or not np.allclose(first.origin, later.origin)
    a, b = (water_texture(s).levels[0][..., 0].astype(float) for s in (1, 2))
    # No shift of one explains the other: the highest peak of their circular correlation is noise.
    a, b = a - a.mean(), b - b.mean()
    correlation = np.fft.irfft2(np.fft.rfft2(a) * np.conj(np.fft.rfft2(b))) / (a.std() * b.std() * a.size)
    assert np.abs(correlation).max() < 0.25


def test_noise_is_normalised_and_tiles() -> None:
    for field in (fractal(100, 130, np.random.default_rng(0)), periodic(128, np.random.default_rng(1))):
        assert field.mean() == pytest.approx(0.0, abs=1e-4)
        assert field.std() == pytest.approx(1.0, abs=1e-4)
    tile = periodic(128, np.random.default_rng(1), exponent=2.0)
    across_the_seam, within = np.abs(tile[:, 0] - tile[:, -1]).mean(), np.abs(np.diff(tile, axis=1)).mean()
    assert across_the_seam == pytest.approx(within, rel=0.3)


def test_texture_levels_keep_the_mean_and_repeat() -> None:
    image = np.random.default_rng(0).integers(0, 256, (64, 128, 3), dtype=np.uint8)
    texture = Texture.from_image(image, 0.5)
    assert texture.extent_m == (64.0, 32.0)
    for level in texture.levels:
        assert level.mean() == pytest.approx(image.mean(), abs=1.5)
    u, v = np.full((1, 1), 3 * 0.5 + 0.25, np.float32), np.full((1, 1), 7 * 0.5 + 0.25, np.float32)
    np.testing.assert_array_equal(texture.sample(u, v, 0)[0, 0], image[7, 3])
    np.testing.assert_array_equal(texture.sample(u + 64.0, v - 32.0, 0)[0, 0], image[7, 3])


def test_sensor_noise_follows_its_model() -> None:
    options = SensorOptions(
        vignetting=0.0, exposure_sigma_ev=0.0, white_balance_sigma=0.0, read_noise=1.5, shot_noise=3.0
    )
    for grey in (40, 128, 200):
        photo = expose(np.full((300, 400, 3), grey, np.uint8), np.random.default_rng(grey), options)
        wanted = np.sqrt(1.5**2 + 3.0**2 * grey / 128.0 + 1.0 / 12.0)
        assert photo.mean() == pytest.approx(grey, abs=0.05)
        assert photo.std() == pytest.approx(wanted, rel=0.02)


def test_vignetting_and_exposure() -> None:
    white = np.full((200, 300, 3), 120, np.uint8)
    calm = SensorOptions(read_noise=0.0, shot_noise=0.0, exposure_sigma_ev=0.0, white_balance_sigma=0.0)
    photo = expose(white, np.random.default_rng(0), replace(calm, vignetting=0.3))
    assert photo[100, 150, 1] == 120
    assert photo[0, 0, 1] == pytest.approx(0.7 * 120, abs=1.5)
    means = [
        expose(white, np.random.default_rng(i), replace(calm, vignetting=0, exposure_sigma_ev=0.2))[
            ..., 1
        ].mean()
        for i in range(200)
    ]
    assert np.std(np.log2(np.array(means) / 120)) == pytest.approx(0.2, rel=0.15)


def test_survey_overlaps_as_asked(town: Scene) -> None:
    options = FlightOptions(lines=3, per_line=6, oblique=2, width=800, height_m=70.0)
    shots = survey(town, options, 4)
    assert len(shots) == 20
    camera = drone_device(800).camera
    centres = np.array([s.cam_from_local.center for s in shots])
    steps = np.linalg.norm(np.diff(centres[:6], axis=0), axis=1)
    # 240 x 600 / 599 px footprints at 70 m, less the overlap; positions sway by decimetres.
    assert np.mean(steps) == pytest.approx(0.22 * 70.0 * 600 / camera.focal_px, abs=1.5)
    assert centres[:18, 2] == pytest.approx(70.0, abs=2.5)
    down = np.array([s.cam_from_local.rotation[2] for s in shots])
    assert (down[:18, 2] < -0.98).all()
    assert down[18:, 2] == pytest.approx(-np.sin(np.radians(50)), abs=0.1)
    # Oblique photos look at the middle.
    assert (np.einsum("ij,ij->i", down[18:, :2], -centres[18:, :2]) > 0).all()
    times = [s.time for s in shots]
    assert times == sorted(times)
    assert all(t.tzinfo is not None for t in times)


def test_gps_errors_are_realistic_or_none(town: Scene) -> None:
    truth = survey(town, FlightOptions(gps_error="none"), 1)
    for shot in truth:
        np.testing.assert_allclose(shot.gps_enu, shot.cam_from_local.center, atol=1e-9)
    spreads, means, heights = [], [], []
    for seed in range(30):
        shots = survey(town, FlightOptions(), seed)
        error = np.array([s.gps_enu - s.cam_from_local.center for s in shots if s.gps_enu is not None])
        assert len(error) == len(shots)
        spreads.append(error[:, :2].std(axis=0))
        means.append(error[:, :2].mean(axis=0))
        heights.append(abs(error[:, 2].mean()))
    assert 0.7 < np.mean(spreads) < 1.7
    assert 0.5 < np.std(means) < 2.0  # a bias of the whole flight, which averaging does not remove
    # 3 to 8 m either way, and the same first-order process as the plan position's on top.
    assert np.mean(np.array(heights) > 2.0) > 0.8
    assert 3.5 < np.mean(heights) < 7.5


def test_visitors_come_from_elsewhere(town: Scene) -> None:
    flight = FlightOptions()
    shots = visitors(town, flight, 60, 1, width=640)
    half = np.array(survey_half_extent(flight))
    centres = np.array([s.cam_from_local.center for s in shots])
    in_town = centres @ town.enu_from_town  # rows: town axes
    assert (np.abs(in_town[:, :2]) <= half).all()
    assert centres[:, 2].min() >= 0.75 * 70.0
    assert centres[:, 2].max() <= 1.25 * 70.0
    assert np.ptp(centres[:, 2]) > 20
    assert len({s.device.model for s in shots}) == 2
    pitch = np.degrees(np.arcsin([s.cam_from_local.rotation[2, 2] for s in shots]))
    assert pitch.min() >= -90.0
    assert -60 < pitch.max() < -40
    survey_centres = np.array([s.cam_from_local.center for s in survey(town, flight, 1)])
    nearest = np.linalg.norm(centres[:, None] - survey_centres[None], axis=2).min(axis=1)
    assert np.median(nearest) > 4.0


def test_pedestrians_stand_on_pavements(town: Scene) -> None:
    shots = pedestrians(town, 24, 1, width=800, extent_m=(80.0, 70.0))
    assert (
        len({(s.device.camera.width, s.device.camera.height, s.device.camera.focal_px) for s in shots}) == 4
    )
    assert any(s.device.camera.height > s.device.camera.width for s in shots)
    in_town = np.array([s.cam_from_local.center for s in shots]) @ town.enu_from_town
    above = in_town[:, 2] - np.maximum(town.plan.height(in_town[:, 1]), 0.0)
    assert above.min() >= 1.5
    assert above.max() <= 1.75
    believed = [s for s in shots if s.gps_enu is not None]
    assert len(believed) == 12
    errors = np.array([s.gps_enu - s.cam_from_local.center for s in believed if s.gps_enu is not None])
    assert 5.0 < errors[:, :2].std() < 20.0


@pytest.mark.parametrize(
    ("lat_lon_h", "refs"),
    [
        ((48.137412345678, 11.416287654321, 621.2346), ("N", "E", 0)),
        ((-33.451254321, -70.62159999999999, -12.3456), ("S", "W", 1)),
        ((59.99999999999, 0.0, 0.0), ("N", "E", 0)),
    ],
)
def test_exif_position_is_exact_to_under_a_millimetre(
    town: Scene, lat_lon_h: tuple[float, float, float], refs: tuple[str, str, int]
) -> None:
    shot = survey(town, FlightOptions(lines=1, per_line=1, oblique=0), 1)[0]
    gps = exif_of(shot, lat_lon_h).get_ifd(ExifTags.IFD.GPSInfo)

    def degrees(key: int) -> float:
        d, m, s = (Fraction(v.numerator, v.denominator) for v in gps[key])
        assert 0 <= m < 60
        assert 0 <= s < 60
        return float(d + m / 60 + s / 3600)

    tags = ExifTags.GPS
    assert (gps[tags.GPSLatitudeRef], gps[tags.GPSLongitudeRef], gps[tags.GPSAltitudeRef][0]) == refs
    # 1e-9 degrees are 0.1 mm; the last digit written is half of 1e-5 arc seconds.
    assert degrees(tags.GPSLatitude) == pytest.approx(abs(lat_lon_h[0]), abs=1.5e-9)
    assert degrees(tags.GPSLongitude) == pytest.approx(abs(lat_lon_h[1]), abs=1.5e-9)
    assert float(gps[tags.GPSAltitude]) == pytest.approx(abs(lat_lon_h[2]), abs=0.00051)


@pytest.mark.evaluation
def test_the_land_around_a_town_of_pieces_does_not_repeat_every_256_m() -> None:
    plain, varied = (town_textures(3, pieces)["fields"] for pieces in (1, 2))
    side = plain.levels[0].shape[0]
    land = varied.levels[0].astype(np.float64)[..., 1]
    assert land.shape == (4 * side, 4 * side)
    for shift in ((side, 0), (0, side), (2 * side, side)):
        again = np.roll(land, shift, axis=(0, 1))
        assert abs(np.corrcoef(land[::8, ::8].ravel(), again[::8, ::8].ravel())[0, 1]) < 0.3
    assert varied.levels[0].std() == pytest.approx(plain.levels[0].std(), rel=0.1)
