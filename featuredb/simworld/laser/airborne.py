"""The town scanned by a laser from an aircraft: strips, several returns, classes, outliers, exact truth."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.camera.photograph import moving_cars
from featuredb.simworld.laser.beams import (
    NOTHING,
    Beams,
    Echoes,
    Hits,
    cross_ellipsoids,
    echoes_of,
    hit_faces,
    return_numbers,
)
from featuredb.simworld.town.ground import Reflectance, scene_reflectance
from featuredb.simworld.town.scene import REFLECTANCE, DayOptions, Faces, Scene, another_day, texture_index
from featuredb.simworld.town.town import BRIDGE_ID, BUILDING_ID, GROUND_ID, TREE_ID, WATER_ID

_SPEED_M_S = 55.0
_TURN_S = 180.0  # between two strips
_GPS_START_S = 396_871_234.0  # adjusted standard GPS time of a day in spring
_DETECTED = 0.012  # weakest echo, as share of a white wall's
_COUNTS = 5200.0  # intensity of a white wall at nadir from the flying height

# ASPRS classes.
UNCLASSIFIED, GROUND, LOW_VEGETATION, MEDIUM_VEGETATION, HIGH_VEGETATION = 1, 2, 3, 4, 5
BUILDING, LOW_NOISE, WATER, BRIDGE_DECK, HIGH_NOISE = 6, 7, 9, 17, 18

_MIRROR_DEG = 2.5  # within this angle off the nadir calm water throws the beam back
_WATER_SEEN = 0.08  # share of beams that water answers beyond it
_HIGH_M = 20.0  # above the ground: where noise counts as high


@dataclass(frozen=True, slots=True, kw_only=True)
class AirborneScanOptions:
    """An airborne scan. The same options and scene give the same points.

    Attributes:
        height_m: of the flight over the town's origin.
        max_scan_angle_deg: to either side.
        overlap: share of a swath that the neighbouring strip covers too.
        heading_deg: of the first strip, clockwise from north; None draws it.
        density_per_m2: pulses of one strip per square metre of its swath; overlaps have twice that.
        range_noise_m: standard deviation along the beam.
        strip_shift_m: standard deviation of each strip's displacement from their mean, per axis; half of it
            in height.
        sway_deg: amplitude of the aircraft's roll and pitch; they are known, and only unsettle the pattern.
        birds, multipath: shares of pulses whose only return is above the town, or below its ground.
        noise_labelled: share of these that carry a class of noise; the rest is unclassified.
        day: what differs from the day of the photos.
    """

    seed: int = 1
    height_m: float = 420.0
    max_scan_angle_deg: float = 20.0
    overlap: float = 0.3
    heading_deg: float | None = None
    density_per_m2: float = 8.0
    margin_m: float = 30.0
    range_noise_m: float = 0.025
    strip_shift_m: float = 0.02
    divergence_mrad: float = 0.3
    sway_deg: float = 0.15
    birds: float = 1e-4
    multipath: float = 2e-4
    noise_labelled: float = 0.7
    day: DayOptions = field(default_factory=lambda: DayOptions(seed=2))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Strip:
    """What the steps of one strip share: faces and its displacement `shift` (3,) in the local frame."""

    scene: Scene
    faces: Faces
    reflectance: Reflectance
    options: AirborneScanOptions
    number: int
    shift: FloatArray


def _answered(
    strip: _Strip, echoes: Echoes, angle_deg: FloatArray, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Which echoes there are: calm water is a mirror, and throws most beams away."""
    on_water = (echoes.face != NOTHING) & (strip.faces.texture[echoes.face] == texture_index("water"))
    seen = (np.abs(angle_deg[echoes.beam]) < _MIRROR_DEG) | (rng.random(len(echoes)) < _WATER_SEEN)
    return np.asarray(~on_water | seen, dtype=bool)


def _with_outliers(
    echoes: Echoes, hits: Hits, options: AirborneScanOptions, rng: np.random.Generator
) -> tuple[Echoes, NDArray[np.bool_]]:
    """Some beams' echoes replaced by one bird or one echo that took a detour; which rows these are."""
    draw = rng.random(hits.distance.size)
    bird, detour = draw < options.birds, draw > 1 - options.multipath
    first = np.concatenate([[True], echoes.beam[1:] != echoes.beam[:-1]])
    odd = (bird | detour)[echoes.beam]
    echoes = echoes.take(~odd | first)
    is_bird, outlier = bird[echoes.beam], (bird | detour)[echoes.beam]
    n = len(echoes)
    ground = hits.distance.ravel()[echoes.beam]
    replaced = np.where(is_bird, ground - rng.uniform(25, 160, n), ground + rng.uniform(1.5, 12.0, n))
    outlier &= np.isfinite(ground)
    none = np.full(n, NOTHING, dtype=np.int32)
    odd_ones: dict[str, Any] = {"distance": replaced, "energy": 1.0, "face": none, "ellipsoid": none}
    changed = {name: np.where(outlier, value, getattr(echoes, name)) for name, value in odd_ones.items()}
    return replace(echoes, **changed), outlier


def _received_light(
    strip: _Strip,
    echoes: Echoes,
    outlier: NDArray[np.bool_],
    xyz: FloatArray,
    direction: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """Received light (n,), as share of what a white wall across the beam at the flying height returns."""
    faces = strip.faces
    normal = np.cross(faces.edge_s, faces.edge_t)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # Leaves hang at all angles.
    share = REFLECTANCE["leaves"] * rng.uniform(0.5, 1.1, len(echoes))
    hard = np.flatnonzero(echoes.face != NOTHING)
    on = echoes.face[hard]
    cosine = np.clip(-np.einsum("ij,ij->i", normal[on], direction[hard]), 0.0, 1.0)
    texture = faces.texture[on]
    share[hard] = cosine * strip.reflectance.at(strip.scene, xyz[hard], texture, faces.object_id[on])
    mirror = (texture == texture_index("water")) & (cosine > np.cos(np.radians(_MIRROR_DEG)))
    share[hard[mirror]] *= rng.exponential(8.0, int(mirror.sum()))
    share[outlier] = rng.uniform(0.02, 0.35, int(outlier.sum()))
    spread = (strip.options.height_m / echoes.distance) ** 2
    return np.asarray(share * echoes.energy * spread, dtype=np.float64)


def _objects_hit(strip: _Strip, echoes: Echoes, outlier: NDArray[np.bool_]) -> NDArray[np.int32]:
    leaf = strip.scene.ellipsoids.object_id[echoes.ellipsoid] if len(strip.scene.ellipsoids) else NOTHING
    ids = np.where(echoes.face != NOTHING, strip.faces.object_id[echoes.face], leaf)
    return np.where(outlier, NOTHING, ids).astype(np.int32)


def _classes_of(
    strip: _Strip,
    object_id: NDArray[np.int32],
    xyz: FloatArray,
    outlier: NDArray[np.bool_],
    rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """ASPRS classes (n,): cars, masts and clutter are unclassified, as in public scans."""
    above = xyz[:, 2] - strip.scene.plan.height((xyz @ strip.scene.enu_from_town)[:, 1])
    classes = np.full(len(xyz), UNCLASSIFIED, dtype=np.uint8)
    for object_class, rows in (
        (GROUND, object_id == GROUND_ID),
        (WATER, object_id == WATER_ID),
        (BRIDGE_DECK, object_id == BRIDGE_ID),
        (BUILDING, (object_id >= BUILDING_ID) & (object_id < TREE_ID)),
    ):
        classes[rows] = object_class
    tree = (object_id >= TREE_ID) & (object_id < TREE_ID + 10_000)
    height_class = np.select([above > 2.0, above > 0.5], [HIGH_VEGETATION, MEDIUM_VEGETATION], LOW_VEGETATION)
    classes[tree] = height_class[tree]
    labelled = outlier & (rng.random(len(xyz)) < strip.options.noise_labelled)
    classes[labelled] = np.where(above[labelled] > _HIGH_M, HIGH_NOISE, LOW_NOISE)
    return classes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AirborneScan:
    """Points of a scan in the order in which they were measured, and what is true of them.

    Attributes:
        frame: local east-north-up frame of `xyz`. epsg: UTM zone of `utm`; heights are ellipsoidal.
        xyz: (n, 3) float64 metres.
        intensity: (n,) uint16.
        classification: (n,) uint8, ASPRS.
        return_number, number_of_returns: (n,) uint8, from 1.
        scan_angle_deg: (n,) float32, positive to the left of the flight.
        gps_time_s: (n,) float64, adjusted standard GPS time.
        strip: (n,) uint16, from 1.
        object_id: (n,) int32 of the scene's object, SKY_ID (-1) for birds and multipath.
        face: (n,) int32, row of the faces of the scanned day's scene, `another_day(scene, options.day)`; -1
            for leaves, cars under way and outliers.
        outlier: (n,) bool, birds and multipath, whatever their class says.
    """

    frame: LocalFrame
    epsg: int
    xyz: FloatArray
    intensity: NDArray[np.uint16]
    classification: NDArray[np.uint8]
    return_number: NDArray[np.uint8]
    number_of_returns: NDArray[np.uint8]
    scan_angle_deg: NDArray[np.float32]
    gps_time_s: FloatArray
    strip: NDArray[np.uint16]
    object_id: NDArray[np.int32]
    face: NDArray[np.int32]
    outlier: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.xyz)

    def utm(self) -> FloatArray:
        """Easting, northing, ellipsoidal height (n, 3) float64, metres."""
        return self.frame.utm_from_enu(self.xyz, self.epsg)


def scan_town(scene: Scene, options: AirborneScanOptions | None = None) -> AirborneScan:
    """Fly over a scene and scan it, with a margin around the town."""
    options = options or AirborneScanOptions()
    rng = np.random.default_rng((scene.seed, options.seed, 51))
    heading = float(rng.uniform(0, 180)) if options.heading_deg is None else options.heading_deg
    today = another_day(scene, options.day)
    reflectance = scene_reflectance(scene)
    columns: list[dict[str, NDArray]] = []  # type: ignore[type-arg]
    strips = _strips(scene, options, heading)
    # What all strips share is an error of the datum, which nobody could see: their mean is taken out.
    shifts = rng.normal(0, options.strip_shift_m, (len(strips), 3)) * [1, 1, 0.5]
    shifts -= shifts.mean(axis=0)
    for i, (flight_from_local, track_y, reach_x) in enumerate(strips):
        moment = 1000 * options.seed + i
        faces = Faces.concatenate([today.faces, moving_cars(today, moment)])
        strip = _Strip(
            scene=today, faces=faces, reflectance=reflectance, options=options, number=i + 1, shift=shifts[i]
        )
        columns.append(_scan_strip(strip, flight_from_local, track_y, reach_x, rng))
    merged = {name: np.concatenate([c[name] for c in columns]) for name in columns[0]}
    return AirborneScan(frame=scene.frame, epsg=scene.epsg, **merged)


def _strips(
    scene: Scene, options: AirborneScanOptions, heading_deg: float
) -> list[tuple[FloatArray, float, tuple[float, float]]]:
    """flight_from_local (3, 3), y of the track in those axes, and its reach along x, of strips to and fro."""
    half = 0.5 * np.asarray(scene.plan.size) + options.margin_m
    corners = np.array([[a * half[0], b * half[1], 0.0] for a in (-1, 1) for b in (-1, 1)])
    strips = []
    width = 2 * options.height_m * np.tan(np.radians(options.max_scan_angle_deg))
    spacing = (1 - options.overlap) * width
    for back in (False, True):
        a = np.radians(90.0 - heading_deg + (180.0 if back else 0.0))
        turn = np.array([[np.cos(a), np.sin(a), 0.0], [-np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
        x, y, _ = (corners @ scene.enu_from_town.T @ turn.T).T
        # A little less than the whole swath counts: terrain above the origin narrows it.
        count = max(1, int(np.ceil((np.ptp(y) - 0.9 * width) / spacing)) + 1)
        for i in range(count):
            track = (i - 0.5 * (count - 1)) * spacing
            if (i % 2 == 1) == back:
                strips.append((i, turn, -track if back else track, (float(x.min()), float(x.max()))))
    return [(turn, track, reach) for _, turn, track, reach in sorted(strips, key=lambda s: s[0])]


def _beams(options: AirborneScanOptions, reach: tuple[float, float], rng: np.random.Generator) -> Beams:
    """The grid of beams of a strip over the origin's track."""
    limit = np.radians(options.max_scan_angle_deg)
    across = max(2, round(2 * options.height_m * np.tan(limit) * np.sqrt(options.density_per_m2)))
    dx = 1.0 / np.sqrt(options.density_per_m2)
    angles = np.linspace(-limit, limit, across)
    rows = int(np.ceil((reach[1] - reach[0]) / dx))
    s = np.arange(rows) * dx
    sway = np.radians(options.sway_deg)
    waves = [
        sway * np.sin(2 * np.pi * (s / float(rng.uniform(70, 160)) + float(rng.random()))) for _ in range(2)
    ]
    direction = _directions(
        angles[None] + waves[0][:, None], np.broadcast_to(waves[1][:, None], (rows, across))
    )
    return Beams(
        x0=reach[0], dx=dx, height=options.height_m, angles=angles, direction=direction, sway=1.5 * sway
    )


def _directions(roll: FloatArray, pitch: FloatArray) -> FloatArray:
    """Unit vectors (rows, columns, 3) of angles to the left of and ahead of the nadir, rad."""
    direction = np.stack([np.tan(pitch), np.tan(roll), np.full_like(roll, -1.0)], axis=-1)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return direction


def _aside(beams: Beams, divergence_rad: float, rng: np.random.Generator) -> Beams:
    """The same beams, each turned to a random place within its footprint."""
    # A Gaussian beam's full divergence at 1/e^2 is four standard deviations.
    direction = beams.direction + rng.normal(0, divergence_rad / 4, beams.direction.shape) * [1, 1, 0]
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return replace(beams, direction=direction, sway=beams.sway + 2 * divergence_rad)


def _scan_strip(
    strip: _Strip,
    flight_from_local: FloatArray,
    track_y: float,
    reach_x: tuple[float, float],
    rng: np.random.Generator,
) -> dict[str, NDArray]:  # type: ignore[type-arg]
    """Columns of AirborneScan for one strip."""
    options = strip.options
    beams = _beams(options, reach_x, rng)
    to_track = np.array([0.0, -track_y, 0.0])
    faces = strip.faces.moved(flight_from_local, to_track)
    hits = hit_faces(beams, faces)
    aside = hit_faces(_aside(beams, 1e-3 * options.divergence_mrad, rng), faces)
    crowns = strip.scene.ellipsoids
    crossings = cross_ellipsoids(beams, crowns, crowns.center @ flight_from_local.T + to_track)
    echoes = echoes_of(hits, aside, crossings, rng)
    angle_deg = np.degrees(np.tile(beams.angles, beams.shape[0]))
    echoes = echoes.take(_answered(strip, echoes, angle_deg, rng))
    echoes, outlier = _with_outliers(echoes, hits, options, rng)

    start, direction = _rays(beams, echoes.beam, flight_from_local, to_track)
    true_xyz = start + direction * echoes.distance[:, None]
    strength = _received_light(strip, echoes, outlier, true_xyz, direction, rng)
    inside = _inside(strip.scene, true_xyz, options.margin_m) & (strength > _DETECTED)
    echoes, outlier, strength = echoes.take(inside), outlier[inside], strength[inside]
    direction, true_xyz = direction[inside], true_xyz[inside]

    noise = rng.normal(0, options.range_noise_m, len(echoes))
    number, returns = return_numbers(echoes.beam)
    counts = _COUNTS * rng.normal(1.0, 0.03) * strength * rng.normal(1.0, 0.05, len(echoes))
    counts += rng.normal(0, 12.0, len(echoes))
    row = echoes.beam / beams.shape[1]
    object_id = _objects_hit(strip, echoes, outlier)
    return {
        "xyz": true_xyz + direction * noise[:, None] + strip.shift,
        "intensity": np.clip(np.round(counts), 1, 65_535).astype(np.uint16),
        "classification": _classes_of(strip, object_id, true_xyz, outlier, rng),
        "return_number": number,
        "number_of_returns": returns,
        "scan_angle_deg": angle_deg[echoes.beam].astype(np.float32),
        "gps_time_s": _GPS_START_S + _TURN_S * strip.number + row * beams.dx / _SPEED_M_S,
        "strip": np.full(len(echoes), strip.number, dtype=np.uint16),
        "object_id": object_id,
        "face": np.where(echoes.face < len(strip.scene.faces), echoes.face, NOTHING).astype(np.int32),
        "outlier": outlier,
    }


def _rays(
    beams: Beams, beam: NDArray[np.int64], flight_from_local: FloatArray, to_track: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Starts and unit directions (n, 3) of beams in the local frame."""
    rows, columns = np.divmod(beam, beams.shape[1])
    x = beams.x0 + beams.dx * (rows + columns / beams.shape[1])
    start = np.stack([x, np.zeros_like(x), np.full_like(x, beams.height)], axis=1) - to_track
    return start @ flight_from_local, beams.direction.reshape(-1, 3)[beam] @ flight_from_local


def _inside(scene: Scene, xyz: FloatArray, margin_m: float) -> NDArray[np.bool_]:
    town = xyz @ scene.enu_from_town
    half = 0.5 * np.asarray(scene.plan.size) + margin_m
    return np.asarray((np.abs(town[:, :2]) <= half).all(axis=1))
