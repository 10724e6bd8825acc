"""The airborne scan: points against an independent intersection, density, returns, classes, intensity."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.laser import airborne as classes
from featuredb.simworld.laser.airborne import AirborneScan, AirborneScanOptions, scan_town
from featuredb.simworld.laser.beams import RANGE_RESOLUTION_M
from featuredb.simworld.town.scene import REFLECTANCE, DayOptions, Faces, Scene, another_day, texture_index
from featuredb.simworld.town.town import BUILDING_ID, TREE_ID, make_town

OPTIONS = AirborneScanOptions(
    seed=3, height_m=300.0, max_scan_angle_deg=14.0, margin_m=5.0, birds=1e-3, multipath=1e-3
)
CLEAN = replace(
    OPTIONS,
    range_noise_m=0.0,
    strip_shift_m=0.0,
    divergence_mrad=0.0,
    birds=0.0,
    multipath=0.0,
    density_per_m2=2.0,
)


@pytest.fixture(scope="module")
def town() -> Scene:
    return make_town(4, size_m=(160.0, 150.0))


@pytest.fixture(scope="module")
def scan(town: Scene) -> AirborneScan:
    return scan_town(town, OPTIONS)


def distance_to_faces(points: FloatArray, faces: Faces) -> FloatArray:
    """Distance (n,) of points to the nearest face, by the nearest point of a triangle or parallelogram."""
    nearest = np.full(len(points), np.inf)
    for i in range(len(faces)):
        s, t = faces.edge_s[i], faces.edge_t[i]
        q = points - faces.origin[i]
        a = np.linalg.lstsq(np.column_stack([s, t]), q.T, rcond=None)[0]
        total = np.maximum(a.sum(axis=0), 1.0) if faces.triangle[i] else 1.0
        a = np.clip(a, 0.0, 1.0) / total
        nearest = np.minimum(nearest, np.linalg.norm(q - (a.T @ np.stack([s, t])), axis=1))
    return nearest


def static(scan: AirborneScan, town: Scene) -> NDArray[np.bool_]:
    """Points of what stands still, leaves and cars left out."""
    trunk_or_leaf = scan.object_id >= TREE_ID
    return ~scan.outlier & ~trunk_or_leaf


def test_points_lie_where_beams_meet_faces(town: Scene) -> None:
    """Every point of a noiseless scan, but leaves and cars under way, lies on a face."""
    scan = scan_town(town, CLEAN)
    today = another_day(town, CLEAN.day).faces
    rows = np.flatnonzero(static(scan, town))
    rows = np.random.default_rng(0).choice(rows, 300, replace=False)
    assert distance_to_faces(scan.xyz[rows], today).max() < 1e-6
    # And on the one that the truth names.
    off = scan.xyz[rows] - today.origin[scan.face[rows]]
    normal = np.cross(today.edge_s, today.edge_t)[scan.face[rows]]
    assert np.abs(np.einsum("ij,ij->i", off, normal) / np.linalg.norm(normal, axis=1)).max() < 1e-6
    assert (scan.face[scan.outlier] == -1).all()


def test_nothing_stands_between_the_scanner_and_a_point(town: Scene) -> None:
    """Along the beam, backwards: the object hit is the first; a segment test of its own finds none before."""
    scan = scan_town(town, replace(CLEAN, heading_deg=0.0, sway_deg=0.0))
    today = another_day(town, CLEAN.day).faces
    rng = np.random.default_rng(1)
    rows = rng.choice(np.flatnonzero(static(scan, town)), 400, replace=False)
    up = np.tan(np.radians(scan.scan_angle_deg[rows]))
    # Strips fly north, then south: left of the flight is west, then east. From the point back to the scanner.
    side = np.where(scan.strip[rows] % 2 == 1, up, -up)
    back = np.stack([side, np.zeros_like(side), np.ones_like(side)], axis=1)
    normal = np.cross(today.edge_s, today.edge_t)
    for p, d in zip(scan.xyz[rows] + 0.02 * back, back, strict=True):
        toward = normal @ d
        r = np.einsum("ij,ij->i", normal, today.origin - p) / np.where(toward > 0, toward, 1.0)
        q = p + r[:, None] * d - today.origin
        square = np.einsum("ij,ij->i", normal, normal)
        s = np.einsum("ij,ij->i", np.cross(q, today.edge_t), normal) / square
        t = np.einsum("ij,ij->i", np.cross(today.edge_s, q), normal) / square
        outer = np.where(today.triangle, s + t, np.maximum(s, t))
        blocked = (toward > 0) & (r > 0) & (s > 1e-6) & (t > 1e-6) & (outer < 1 - 1e-6)
        assert not blocked.any()


def test_noise_is_as_asked(town: Scene) -> None:
    """On open ground and flat roofs the heights scatter by the range noise around the faces."""
    scan = scan_town(town, replace(CLEAN, range_noise_m=0.03, density_per_m2=1.0))
    ground = static(scan, town) & (scan.classification == classes.GROUND)
    plan_y = (scan.xyz[ground] @ town.enu_from_town)[:, 1]
    flat = (plan_y > -0.5 * 150.0 + 1) & (plan_y < town.plan.river[0] - 1)
    off = scan.xyz[ground][flat, 2] - town.plan.height(plan_y[flat])
    assert off.std() == pytest.approx(0.03, rel=0.05)
    assert off.mean() == pytest.approx(0.0, abs=0.002)


def test_strips_are_displaced_as_asked(town: Scene) -> None:
    moved = scan_town(town, replace(CLEAN, strip_shift_m=0.05))
    still = scan_town(town, CLEAN)
    # The same beams answer, so that the points pair up, strip by strip.
    for strip in np.unique(still.strip):
        shift = moved.xyz[moved.strip == strip] - still.xyz[still.strip == strip]
        assert np.ptp(shift, axis=0).max() < 1e-9
        assert 0.005 < np.linalg.norm(shift[0]) < 0.25


def test_the_same_options_give_the_same_points(town: Scene, scan: AirborneScan) -> None:
    again = scan_town(town, OPTIONS)
    for name in ("xyz", "intensity", "classification", "return_number", "gps_time_s", "strip", "object_id"):
        np.testing.assert_array_equal(getattr(again, name), getattr(scan, name))
    other = scan_town(town, replace(OPTIONS, seed=4))
    assert len(other) != len(scan) or not np.allclose(other.xyz, scan.xyz)


def test_density_and_overlap(town: Scene, scan: AirborneScan) -> None:
    """Pulses per square metre of one strip in the open, and twice that where strips overlap."""
    town_xy = scan.xyz @ town.enu_from_town
    first = (scan.return_number == 1) & (np.abs(town_xy[:, :2]) < [70.0, 65.0]).all(axis=1)
    first &= scan.classification == classes.GROUND
    cells = np.floor(town_xy[first, :2] / 4.0).astype(int)
    _, inverse, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    strips = np.zeros((len(count), 4), bool)
    strips[inverse.ravel(), scan.strip[first]] = True
    full = np.percentile(count[strips.sum(axis=1) == 1], 60) / 16.0
    assert full == pytest.approx(OPTIONS.density_per_m2, rel=0.15)
    assert len(np.unique(scan.strip)) == 2
    double = np.percentile(count[strips.sum(axis=1) == 2], 75) / 16.0
    assert double == pytest.approx(2 * full, rel=0.25)
    assert np.abs(scan.scan_angle_deg).max() <= OPTIONS.max_scan_angle_deg + 1e-4
    assert (np.diff(scan.gps_time_s) >= 0).all()


def test_trees_give_several_returns_and_let_the_ground_be_seen(town: Scene, scan: AirborneScan) -> None:
    """Return numbers count up along each beam; under crowns some beams reach the ground, most do not."""
    pulse = np.cumsum(scan.return_number == 1)
    _, counts = np.unique(pulse, return_counts=True)
    np.testing.assert_array_equal(np.repeat(counts, counts), scan.number_of_returns)
    later = scan.return_number > 1
    gap = np.linalg.norm(np.diff(scan.xyz, axis=0), axis=1)[later[1:]]
    assert gap.min() > RANGE_RESOLUTION_M - 6 * np.sqrt(2) * OPTIONS.range_noise_m
    center, radii = town.ellipsoids.center, town.ellipsoids.radii
    big = np.flatnonzero(radii[:, 0] > 1.5)
    under = np.zeros(len(scan), dtype=bool)
    for i in big:  # beams near the vertical that pass well inside a crown
        under |= np.hypot(*(scan.xyz[:, :2] - center[i, :2]).T) < 0.5 * radii[i, 0]
    below = under & ~scan.outlier & (np.abs(scan.scan_angle_deg) < 12)
    reached = np.unique(pulse[below & (scan.classification == classes.GROUND)])
    assert 0.05 < len(reached) / len(np.unique(pulse[below])) < 0.5
    leaf = (scan.object_id >= TREE_ID) & (scan.object_id < TREE_ID + 10_000)
    assert scan.number_of_returns[leaf].max() >= 3
    # Leaves lie inside crowns, within the noise.
    p = scan.xyz[leaf][::7]
    inside = [(np.sum(((p - c) / (r + 0.2)) ** 2, axis=1) < 1) for c, r in zip(center, radii, strict=True)]
    trunk = scan.classification[leaf][::7] != classes.HIGH_VEGETATION
    assert np.mean(np.any(inside, axis=0) | trunk) > 0.99


def test_classes_follow_what_was_hit(town: Scene, scan: AirborneScan) -> None:
    building = (scan.object_id >= BUILDING_ID) & (scan.object_id < TREE_ID)
    assert (scan.classification[building & ~scan.outlier] == classes.BUILDING).all()
    assert {1, 2, 4, 5, 6, 7, 9, 17, 18} <= set(np.unique(scan.classification).tolist())
    noise = np.isin(scan.classification, (classes.LOW_NOISE, classes.HIGH_NOISE))
    assert (noise <= scan.outlier).all()
    n = scan.outlier.sum()
    assert noise.sum() / n == pytest.approx(OPTIONS.noise_labelled, abs=4 * np.sqrt(0.21 / n))
    assert n / (scan.return_number == 1).sum() == pytest.approx(0.002, rel=0.2)
    above = scan.xyz[:, 2] - town.plan.height((scan.xyz @ town.enu_from_town)[:, 1])
    assert (above[scan.classification == classes.HIGH_NOISE] > 20).all()
    # A detour at a roof may end above the ground, one at a street does not.
    assert (above[scan.classification == classes.LOW_NOISE] < 0).mean() > 0.8


def test_intensity_is_the_infrared_of_materials_and_not_the_photo(town: Scene, scan: AirborneScan) -> None:
    assert REFLECTANCE["roof_red"] > 2 * REFLECTANCE["roof_slate"]
    open_ground = (scan.classification == classes.GROUND) & (scan.number_of_returns == 1)
    town_xy = (scan.xyz @ town.enu_from_town)[:, :2]
    street = np.zeros(len(scan), dtype=bool)
    for s in town.plan.streets:
        along, across = (0, 1) if s.along == "x" else (1, 0)
        street |= (np.abs(town_xy[:, across] - s.at) < 2.5) & (
            np.abs(town_xy[:, along] - 0.5 * (s.start + s.end)) < 0.5 * (s.end - s.start)
        )
    asphalt = np.median(scan.intensity[open_ground & street])
    lawn = np.median(scan.intensity[open_ground & ~street])
    assert lawn > 1.8 * asphalt
    water = (scan.classification == classes.WATER) & (np.abs(scan.scan_angle_deg) > 4)
    assert np.median(scan.intensity[water]) < 0.3 * asphalt
    assert water.sum() > 20


def test_intensity_falls_with_the_cosine_of_incidence(town: Scene) -> None:
    """Two slopes of one gabled roof: the ratio of their medians is that of their cosines."""
    scan = scan_town(town, replace(CLEAN, density_per_m2=12.0, heading_deg=40.0))
    ratios = []
    for i, b in enumerate(town.plan.buildings):
        mine = np.flatnonzero(town.faces.object_id == BUILDING_ID + i)
        up = np.cross(town.faces.edge_s[mine], town.faces.edge_t[mine])[:, 2]
        roof = mine[(town.faces.texture[mine] == texture_index(b.roof)) & (up > 1)]
        if b.ridge <= 0 or b.roof == "roof_brown" or len(roof) < 2:
            continue
        normal = np.cross(town.faces.edge_s[roof[:2]], town.faces.edge_t[roof[:2]])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        points = np.flatnonzero((scan.object_id == BUILDING_ID + i) & (scan.strip == 1))
        found = []
        for k in range(2):
            on = points[np.abs((scan.xyz[points] - town.faces.origin[roof[k]]) @ normal[k]) < 1e-6]
            if len(on) > 60:
                a = np.radians(scan.scan_angle_deg[on])
                h = np.radians(40.0)
                left = np.array([-np.cos(h), np.sin(h), 0.0])
                d = np.sin(a)[:, None] * left - np.cos(a)[:, None] * [0.0, 0.0, 1.0]
                found.append((np.median(scan.intensity[on]), np.median(-d @ normal[k])))
        if len(found) == 2:
            ratios.append((found[0][0] / found[1][0]) / (found[0][1] / found[1][1]))
    assert len(ratios) >= 3
    assert np.median(ratios) == pytest.approx(1.0, abs=0.06)


def test_cars_differ_from_day_to_day_and_the_rest_does_not(town: Scene) -> None:
    later = another_day(town, DayOptions(seed=9, to_sun=(0.6, 0.2, 0.7), cars_gone=0.5))
    car = texture_index("car")
    before, after = (set(s.faces.object_id[s.faces.texture == car]) for s in (town, later))
    assert after < before
    assert len(after) / len(before) == pytest.approx(0.5, abs=0.25)
    still = town.faces.texture != car
    np.testing.assert_array_equal(town.faces.origin[still], later.faces.origin[later.faces.texture != car])
    # The light comes from elsewhere: the same paint, another shading.
    sun = town.enu_from_town @ np.asarray(later.plan.to_sun)
    old = town.enu_from_town @ np.asarray(town.plan.to_sun)
    paint = later.faces.tint / later.faces.sunlight(sun)[:, None]
    np.testing.assert_allclose(
        paint[later.faces.texture != car],
        (town.faces.tint / town.faces.sunlight(old)[:, None])[still],
        rtol=1e-9,
    )
