"""Are placements by positions of any quality as uncertain as they say, and can chance place a map?

Flights are the largest maps of the folders, made by an ordinary ingest, and five simulated ones; where a
flight's cameras are then is the truth. Positions are made from it in the ways below, and the flight is placed
by them as if they came from a plain receiver (4 m and 10 m). Printed by kind: how many flights have a place,
how many answer, and how often position and orientation of one of its cameras lie inside the 68 % and 95 %
bounds that the placement gives them.

Then positions that have nothing to do with the photos: drawn at random within a kilometre for three to eight
photos, those of a flight shuffled, and those of another flight.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from featuredb.features.exif.gps import DEFAULT_SIGMA_HORIZONTAL_M, DEFAULT_SIGMA_VERTICAL_M
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera_angles import CameraAngles
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3, point_jacobian
from featuredb.simworld.camera.photograph import look_pose
from ingest.own_frame import held_of
from ingest.register.gps import GpsPlacement, place_by_gps
from tools.commands import largest_map, make, once
from tools.figures import inside_figures, say, squared, study_parser, write_figures

SIGMAS = np.array([DEFAULT_SIGMA_HORIZONTAL_M, DEFAULT_SIGMA_HORIZONTAL_M, DEFAULT_SIGMA_VERTICAL_M])
_TRUE = Sim3(scale=8.5, rotation=so3_exp([0.1, -0.05, 2.0]), translation=np.array([4.0, -7.0, 50.0]))
_SHUFFLES = 4  # of each flight
PARTS = ("position", "orientation")
_CHANCE, _SEED = 1000, 1  # draws of random positions
_COMMON_ROLL_DEG = 1.5  # of simulated flights, as placements assume


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Flight:
    """Where cameras were (n, 3), metres, when (n,), seconds, in this order, and how they were turned."""

    xyz: FloatArray
    times_s: FloatArray
    cam_from_local: tuple[Rigid3, ...]

    def placed(self, positions: FloatArray, angles: Sequence[CameraAngles | None] = ()) -> GpsPlacement:
        """Its reconstruction by positions of a plain receiver, and by the cameras' angles."""
        used = slice(len(positions))
        sigmas = np.tile(SIGMAS, (len(positions), 1))
        held = [replace(pose, rotation=pose.rotation @ _TRUE.rotation) for pose in self.cam_from_local[used]]
        centers = _TRUE.inverse().act(self.xyz[used])
        return place_by_gps(centers, positions, sigmas, self.times_s[used], held_of(held, angles))


def white(sigma_m: float) -> Callable[[Flight, np.random.Generator], FloatArray]:
    """Noise, and as much bias as it leaves of what a plain receiver says."""

    def error(flight: Flight, rng: np.random.Generator) -> FloatArray:
        rest = np.sqrt(np.maximum(SIGMAS**2 - sigma_m**2, 0.0))
        return rng.normal(0.0, sigma_m, flight.xyz.shape) + rng.normal(0.0, 1.0, 3) * rest

    return error


def _drift(flight: Flight, rng: np.random.Generator) -> FloatArray:
    """As long-waved as that of a receiver without aid: a line and a wave over the flight."""
    share = (flight.times_s - flight.times_s[0]) / max(float(np.ptp(flight.times_s)), 1.0)
    waves = np.column_stack([share, np.sin(2.0 * np.pi * share)])
    drift = waves @ (rng.normal(0.0, [[0.9], [0.3]], (2, 3)) * [20.0, 20.0, 60.0])
    return np.asarray(drift + white(1.0)(flight, rng))


def _outliers(flight: Flight, rng: np.random.Generator) -> FloatArray:
    """A fifth of the positions is anywhere within some hundred metres."""
    gross = rng.random((len(flight.xyz), 1)) < 0.2
    return np.asarray(white(2.0)(flight, rng) + gross * rng.normal(0.0, 150.0, flight.xyz.shape))


def _one_height(flight: Flight, rng: np.random.Generator) -> FloatArray:
    error = white(2.0)(flight, rng)
    error[:, 2] = float(np.median(flight.xyz[:, 2])) + rng.normal(0.0, SIGMAS[2]) - flight.xyz[:, 2]
    return error


def _lag(flight: Flight, rng: np.random.Generator) -> FloatArray:
    """Positions of two seconds before."""
    times_s = np.maximum.accumulate(flight.times_s + 1e-3 * np.arange(len(flight.xyz)))
    speed = np.gradient(flight.xyz, times_s, axis=0)
    return np.asarray(white(1.0)(flight, rng) - 2.0 * np.clip(speed, -15.0, 15.0))


_KINDS: dict[str, Callable[[Flight, np.random.Generator], FloatArray]] = {
    "noise of 2 m": white(2.0),
    "noise of 5 m": white(5.0),
    "noise of 15 m": white(15.0),
    "drift of 20 and 60 m": _drift,
    "a bias": lambda flight, rng: rng.normal(0.0, 1.0, 3) * SIGMAS + rng.normal(0.0, 0.3, flight.xyz.shape),
    "a fifth far out": _outliers,
    "one height for all": _one_height,
    "a lag of 2 s": _lag,
}


def main() -> None:
    parser = study_parser(__doc__, "--work")
    parser.add_argument("--photos", type=Path, nargs="*", default=[], metavar="FOLDER")
    parser.add_argument("--draws", type=int, default=25, help="of each kind")
    args = parser.parse_args()
    real = [real_flight(folder, args.work) for folder in args.photos]
    with threadpool_limits(1):  # matrices are small
        figures = bounds(real, args.draws)
        figures |= unrelated([*real, *simulated_flights(0)], _CHANCE)
    write_figures(args.json, figures)


def bounds(real: Sequence[Flight], draws: int) -> dict[str, float]:
    """Every kind of error on every flight in turn: what is placed, and whether its bounds hold.

    Simulated flights are drawn anew for each draw: how their photos are held is an error as well.
    """
    scores: list[dict[str, float]] = []
    answering: list[dict[str, float]] = []
    for number, (kind, error) in enumerate(_KINDS.items()):
        own: list[dict[str, float]] = []
        for draw in range(draws):
            rng = np.random.default_rng((_SEED, number, draw))
            flights = [*real, *simulated_flights(draw)]
            flight = flights[draw % len(flights)]
            found = flight.placed(flight.xyz + error(flight, rng))
            if found.reason is None:
                own.append(squares(found, flight.xyz[rng.integers(len(flight.xyz))]))
                answering += [] if found.provisional else own[-1:]
        scores += own
        say(f"{kind:<22} {len(own)} of {draws} placed, inside: {shares('', own)}")
    tried = draws * len(_KINDS)
    return {
        "flights": float(tried),
        "placed": len(scores) / tried,
        "answer": len(answering) / tried,
        **shares("answering_", answering),
        **shares("", scores),
    }


def shares(name: str, scores: Sequence[dict[str, float]]) -> dict[str, float]:
    """Of what `squares` says: shares inside the bounds of position and orientation; `name` before each."""
    figures: dict[str, float] = {}
    for part in PARTS:
        figures |= inside_figures(f"{name}{part}", [score[part] for score in scores])
    return figures


def squares(placed: GpsPlacement, camera: FloatArray) -> dict[str, float]:
    """Squared errors over their covariance: of a camera's position (3,), and of the orientation."""
    off = (_TRUE @ placed.local_from_sfm.inverse()).log()
    by_similarity = {"position": point_jacobian(camera[None])[0], "orientation": np.eye(7)[1:4]}
    covariance = placed.covariance
    return {part: squared(at @ off, at @ covariance @ at.T) for part, at in by_similarity.items()}


def unrelated(flights: Sequence[Flight], chance: int) -> dict[str, float]:
    """How many flights would answer with `chance` draws of random positions, with their own in another order,
    and with those of each other flight."""
    found: dict[str, list[GpsPlacement]] = {"random": [], "shuffled": [], "other": []}
    for draw in range(chance):
        rng = np.random.default_rng((_SEED, 99, draw))
        flight, count = flights[draw % len(flights)], int(rng.integers(3, 9))
        rows = np.sort(rng.choice(len(flight.xyz), count, replace=False))
        held = tuple(flight.cam_from_local[row] for row in rows)
        part = Flight(xyz=flight.xyz[rows], times_s=flight.times_s[rows], cam_from_local=held)
        drawn = np.column_stack([rng.uniform(-500.0, 500.0, (count, 2)), rng.uniform(0.0, 100.0, count)])
        found["random"].append(part.placed(drawn))
    for k, flight in enumerate(flights):
        for draw in range(_SHUFFLES):
            rng = np.random.default_rng((_SEED, 98, k, draw))
            found["shuffled"].append(flight.placed(flight.xyz[rng.permutation(len(flight.xyz))]))
        for other in [*flights[:k], *flights[k + 1 :]]:
            found["other"].append(flight.placed(other.xyz[: len(flight.xyz)]))
    figures: dict[str, float] = {}
    for kind, placements in found.items():
        answer = sum(p.reason is None and not p.provisional for p in placements)
        figures |= {kind: float(len(placements)), f"{kind}_answer": float(answer)}
    return figures


def real_flight(folder: Path, work: Path) -> Flight:
    """The cameras of the largest map of a folder of photos, by its own positions."""
    database = once(work / folder.parent.name, lambda path: make(path, "photos", folder))
    images = sorted(largest_map(database).images, key=lambda image: (image.capture_time, image.name))
    start = images[0].capture_time
    xyz: FloatArray = np.array([image.cam_from_local.center for image in images])
    return Flight(
        xyz=xyz - xyz.mean(axis=0),
        times_s=np.array([(image.capture_time - start).total_seconds() for image in images]),
        cam_from_local=tuple(image.cam_from_local for image in images),
    )


def simulated_flights(draw: int) -> list[Flight]:
    """Strips to and fro, a spiral, a walk around a house, and a winding street."""
    rng = np.random.default_rng((_SEED, 7, draw))
    rolls = np.radians(rng.normal(0.0, _COMMON_ROLL_DEG, 5))
    ways = []
    for lines, per, size in ((4, 8, 160.0), (2, 9, 120.0)):
        x = np.linspace(-0.5, 0.5, per) * size
        plan = [(v, 0.25 * size * k) for k in range(lines) for v in (x if k % 2 == 0 else x[::-1])]
        ways.append(np.column_stack([plan, np.full(len(plan), 60.0)]))
    turn = np.linspace(0.0, 5.0 * np.pi, 40)
    ways.append(np.column_stack([4 * turn * np.cos(turn), 4 * turn * np.sin(turn), 30 + 2 * turn]))
    turn = np.linspace(0.0, 2.0 * np.pi, 24)
    ways.append(np.column_stack([40 * np.cos(turn), 30 * np.sin(turn), 25 + 5 * np.sin(3 * turn)]))
    along = np.linspace(0.0, 300.0, 50)
    ways.append(np.column_stack([along, 40 * np.sin(along / 40), 2 + 0.02 * along]))
    return [
        Flight(
            xyz=xyz + rng.normal(0.0, 0.5, xyz.shape),
            times_s=step_s * np.arange(len(xyz), dtype=np.float64),
            cam_from_local=tuple(_held(xyz, k, roll, rng) for k in range(len(xyz))),
        )
        for xyz, step_s, roll in zip(ways, (4.0, 4.0, 3.0, 3.0, 4.0), rolls, strict=True)
    ]


def _held(xyz: FloatArray, k: int, common_roll: float, rng: np.random.Generator) -> Rigid3:
    """A camera that looks ahead and down, level but for two degrees and what all have in common."""
    ahead = xyz[min(k + 1, len(xyz) - 1)] - xyz[max(k - 1, 0)]
    heading, roll = np.arctan2(ahead[1], ahead[0]), rng.normal(common_roll, np.radians(2.0))
    return look_pose(np.zeros(3), 90.0 - float(np.degrees(heading)), -50.0, -float(np.degrees(roll)))


if __name__ == "__main__":
    main()
