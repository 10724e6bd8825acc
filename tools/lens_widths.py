"""How wide are real lenses around what is known of them beforehand? Measures the widths of the lens priors.

Each folder of photos is ingested into a database of its own in DIR (one that is there is used). Of every lens
of its maps the photos' own say is taken from the adjustment: its normal equations with poses and points
eliminated, less the prior. The widths are those under which the lenses of all cameras together are most
likely (type II maximum likelihood): a lens of which the photos say little says little of the widths.

For each width: what `AdjustOptions` has, what is measured, and between which limits it lies with 95 %
probability (likelihood ratio, the other widths where they are most likely). Also by how much single pictures
are sheared (`ingest.colmap.picture_shear`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.optimize import brentq, minimize
from scipy.stats import chi2, norm

from featuredb.adjust.problem import Problem
from featuredb.adjust.terms import LensWidths, Terms, lens_prior, whole_lens
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from ingest.colmap.adjust import AdjustOptions
from ingest.colmap.map_errors import terms_of_map
from ingest.colmap.picture_shear import picture_shear
from ingest.photos.scan import scan_folder
from ingest.register.block import block_of_map
from tools.commands import all_maps, largest_map, make, once
from tools.figures import say, study_parser, write_figures

WIDTHS = tuple(field.name for field in fields(LensWidths))
_DROP = float(chi2.ppf(0.95, 1)) / 2.0
_OPTIONS = AdjustOptions()
_FAR = float(np.log(100.0))  # widths are looked for up to so many times more and less than assumed


@dataclass(frozen=True, kw_only=True, eq=False)
class Told:
    """What its photos say of one lens.

    Attributes:
        mean: what is known of it beforehand. has_exif: whether the focal length is one of EXIF.
        information: (8, 8) and vector: (8,) of the normal equations of OPENCV's parameters, around the mean.
    """

    mean: Camera
    information: FloatArray
    vector: FloatArray
    has_exif: bool

    @cached_property
    def by_variance(self) -> FloatArray:
        """(5, 8, 8) covariance of a prior for each of the squared widths."""
        none = LensWidths(**dict.fromkeys(WIDTHS, 0.0))
        return np.array([lens_prior(self.mean, replace(none, **{name: 1.0})).covariance for name in WIDTHS])


def main() -> None:
    parser = study_parser(__doc__, "--work")
    parser.add_argument("--photos", type=Path, nargs="+", required=True, metavar="FOLDER")
    args = parser.parse_args()
    databases = {folder: _database(folder, args.work) for folder in args.photos}
    told = [one for folder, database in databases.items() for one in lenses_of(database, folder)]
    write_shears(list(databases.values()))
    assumed, measured = assumed_widths(), measured_widths(told)
    limits = [limits_of(told, measured, k) for k in range(len(WIDTHS))]
    figures: dict[str, float] = {"lenses": len(told), "inside": 0}
    for name, width, wanted, (low, high) in zip(WIDTHS, measured, assumed, limits, strict=True):
        say(f"{name}: {width:.2g}, between {low:.2g} and {high:.2g}; assumed {wanted:.2g}")
        figures |= {name: width, "inside": figures["inside"] + (low <= wanted <= high)}
    write_figures(args.json, figures)


def write_shears(databases: Sequence[Path]) -> None:
    """How much the pictures of each largest map are sheared, and what few maps exceed (log-normal)."""
    largest = [largest_map(path) for path in databases]
    shears = np.log([picture_shear(block_of_map(one)).size for one in largest])
    for path, shear in zip(databases, np.exp(shears), strict=True):
        say(f"{path.name}: pictures sheared by {shear:.1e}")
    if len(shears) > 1:
        few, hardly = np.exp(shears.mean() + shears.std(ddof=1) * norm.isf([0.05, 0.001]))
        say(f"one map in twenty is above {few:.1e}, one in a thousand above {hardly:.1e}")


def lenses_of(database: Path, folder: Path) -> list[Told]:
    """What the photos of each lens of a database's maps say of it."""
    focal_of = {photo.name: photo.focal_px for photo in scan_folder(folder).photos}
    told: list[Told] = []
    for feature_map in all_maps(database):
        block = whole_lens(block_of_map(feature_map))
        focal_px = _focals(block.names, block.camera_of.tolist(), focal_of)
        terms = terms_of_map(block, focal_px, None, _OPTIONS)
        problem = Problem(block, terms, _OPTIONS.threads)
        problem.solve(_OPTIONS.max_iterations, 1e-6)
        told += _told(problem, terms, focal_px)
    say(f"{folder}: {len(told)} lenses")
    return told


def _told(problem: Problem, terms: Terms, focal_px: Mapping[int, float]) -> list[Told]:
    """Posterior information less the prior's, of each lens by itself."""
    block, found = problem.block(), problem.marginals()
    result = []
    for c, (camera, prior) in enumerate(zip(block.cameras, terms.lenses, strict=True)):
        if prior is None or camera.model != "OPENCV" or found.lens_start[c] < 0:
            continue
        posterior = np.linalg.inv(_OPTIONS.dilution * found.lens(c))
        off = np.array(camera.params) - np.array(prior.mean.params)
        # Directions that photos say nothing of have what the prior says, or by its robust loss less.
        root = np.linalg.cholesky(prior.covariance)
        told, axes = np.linalg.eigh(root.T @ posterior @ root - np.eye(len(off)))
        axes = np.linalg.solve(root.T, axes[:, told > 0.0])
        told = told[told > 0.0]
        result.append(
            Told(
                mean=prior.mean,
                information=(axes * told) @ axes.T,
                vector=axes @ (axes.T @ prior.covariance @ posterior @ off),
                has_exif=c in focal_px,
            )
        )
    return result


def assumed_widths() -> FloatArray:
    """(5,) of `WIDTHS`."""
    return np.array(astuple(replace(_OPTIONS.lens, focal_rel=_OPTIONS.exif_focal_rel)))


def measured_widths(told: Sequence[Told]) -> FloatArray:
    """(5,) the most likely ones."""
    start = np.log(assumed_widths())
    best = minimize(
        lambda logs: -log_likelihood(told, np.exp(logs)),
        start,
        method="Nelder-Mead",
        bounds=[(log - _FAR, log + _FAR) for log in start],
        options={"maxiter": 4000},
    )
    return np.asarray(np.exp(best.x))


def log_likelihood(told: Sequence[Told], widths: FloatArray) -> float:
    """Of the photos' say under normal lenses of these widths (5,), up to a constant."""
    variance = np.tile(widths**2, (len(told), 1))
    variance[[not one.has_exif for one in told], 0] = _OPTIONS.lens.focal_rel**2
    covariance = np.einsum("nk,nkij->nij", variance, np.array([one.by_variance for one in told]))
    vector = np.array([one.vector for one in told])[:, :, None]
    whole = np.eye(8) + covariance @ np.array([one.information for one in told])
    most_likely = np.linalg.solve(whole, covariance @ vector)
    return 0.5 * float((vector * most_likely).sum() - np.linalg.slogdet(whole)[1].sum())


def limits_of(told: Sequence[Told], best: FloatArray, which: int) -> tuple[float, float]:
    """Where the likelihood of one width has fallen as far as it does by chance in one of twenty cases."""
    top = log_likelihood(told, best)

    def lack(shift: float) -> float:
        moved = best.copy()
        moved[which] *= np.exp(shift)
        return top - log_likelihood(told, moved) - _DROP

    low, high = np.log(assumed_widths()[which] / best[which]) + np.array([-_FAR, _FAR])
    ends = [brentq(lack, 0.0, far) if abs(far) > 0.0 and lack(far) > 0.0 else far for far in (low, high)]
    return float(best[which] * np.exp(ends[0])), float(best[which] * np.exp(ends[1]))


def _focals(
    names: Sequence[str], camera_of: Sequence[int], focal_of: Mapping[str, float | None]
) -> dict[int, float]:
    """EXIF's focal length of each camera whose photos tell one."""
    told: dict[int, set[float | None]] = {}
    for name, camera in zip(names, camera_of, strict=True):
        told.setdefault(camera, set()).add(focal_of[name])
    return {camera: min(focals) for camera, focals in told.items() if len(focals) == 1 and None not in focals}


def _database(folder: Path, work: Path) -> Path:
    """Of the folder's photos, made if it is not there."""
    control = folder.parent / "gcp_list.txt"
    more = ("--gcp", str(control)) if control.exists() else ()
    target = work / folder.parent.name / folder.name / "db"
    return once(target, lambda database: make(database, "photos", folder, more))


if __name__ == "__main__":
    main()
