"""How right the colours are that a scan takes from an ortho image, with and without asking what is seen.

On the simulated town every point's true colour is known: its face's texture under that day's sun. The table
shows, by what was hit, the share of points that take a colour and the share whose colour is wrong.

    .venv/bin/python tools/ortho_study.py --size short
"""

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.lidar.geotiff import write_geotiff
from featuredb.lidar.nadir_view import NadirOptions
from featuredb.lidar.ortho import ColourOptions, colour_by_ortho, open_ortho
from featuredb.simworld.airborne import AirborneScan, ScanOptions, scan_town
from featuredb.simworld.days import another_day
from featuredb.simworld.look import scene_look
from featuredb.simworld.ortho import OrthoOptions, make_ortho
from featuredb.simworld.scene import TEXTURES, Scene
from featuredb.simworld.town import BUILDING_ID, TREE_ID
from featuredb.simworld.world import WorldOptions, town_of

# Largest difference of a channel. Textures alone scatter by some 20 between the point's spot and the pixel.
_WRONG = 60
_FOOTPRINT_M = 0.25
_LEAVES_RGB = np.array([74.0, 98.0, 48.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One line of the table: shares of all points of a kind."""

    kind: str
    points: int
    coloured: float
    wrong_of_coloured: float
    median_error: float


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", choices=("short", "full"), default="short")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--picture", type=Path, help="write plan views: intensity, plain lookup, with visibility"
    )
    args = parser.parse_args()
    cv2.setNumThreads(1)
    options = WorldOptions.short(args.seed) if args.size == "short" else WorldOptions(seed=args.seed)
    scene, scan_options = town_of(options), ScanOptions()
    scan = scan_town(scene, scan_options)
    today = another_day(scene, scan_options.day)
    truth, known = true_colours(today, scan)
    kinds = kinds_of(scene, today, scan)
    keep = ~np.isin(scan.classification, (7, 18))  # what a store drops
    pictures = []
    for lean in (False, True):
        # The scan's own day and colours as they are: what is left is place and visibility.
        ortho_options = OrthoOptions(
            lean=lean, season=(1.0, 1.0, 1.0), contrast=1.0, gamma=1.0, day=scan_options.day
        )
        ortho = make_ortho(scene, ortho_options)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "ortho.tif"
            write_geotiff(
                path, ortho.rgb, epsg=ortho.epsg, west=ortho.west, north=ortho.north, pixel_m=ortho.pixel_m
            )
            image = open_ortho(path)
            for name, nadir in (("plain lookup", None), ("seen from above", NadirOptions())):
                rgb = np.zeros((len(scan), 3), np.uint8)
                coloured = np.zeros(len(scan), dtype=bool)
                rgb[keep], coloured[keep] = colour_by_ortho(
                    scan.utm()[keep], scan.epsg, None, image, ColourOptions(nadir=nadir)
                )
                error = np.abs(rgb - truth).max(axis=1)
                print(f"\n{'leaning roofs' if lean else 'true ortho image'}, {name}")
                print_table([row_of(k, kinds[k] & keep & known, coloured, error) for k in kinds])
                pictures.append(plan_view(scan, keep & coloured, rgb))
    if args.picture is not None:
        grey = np.clip(scan.intensity / np.percentile(scan.intensity, 99) * 255, 0, 255).astype(np.uint8)
        pictures.insert(0, plan_view(scan, keep, np.repeat(grey[:, None], 3, axis=1)))
        cv2.imwrite(str(args.picture), np.hstack([pictures[0], pictures[3], pictures[4]])[..., ::-1])


def true_colours(today: Scene, scan: AirborneScan) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Colours (n, 3) of the surfaces that were hit, and for which points (n,) they are known."""
    look = scene_look(today)
    faces = today.faces
    result = np.zeros((len(scan), 3))
    rows = np.flatnonzero(scan.face >= 0)
    face = scan.face[rows]
    s, t = faces.edge_s[face], faces.edge_t[face]
    normal = np.cross(s, t)
    q = scan.xyz[rows] - faces.origin[face]
    square = np.einsum("ij,ij->i", normal, normal)
    a = np.einsum("ij,ij->i", np.cross(q, t), normal) / square
    b = np.einsum("ij,ij->i", np.cross(s, q), normal) / square
    uv = faces.uv[face]
    u, v = uv[:, 0] + a * uv[:, 2] + b * uv[:, 4], uv[:, 1] + a * uv[:, 3] + b * uv[:, 5]
    for i, texture in enumerate(look.textures):
        mine = np.flatnonzero(faces.texture[face] == i)
        if not len(mine):
            continue
        level = int(np.clip(round(np.log2(_FOOTPRINT_M / texture.texel_m)), 0, len(texture.levels) - 1))
        wide, high = texture.extent_m
        for part in np.array_split(mine, len(mine) // 30_000 + 1):
            at = (u[part] % wide).astype(np.float32)[:, None], (v[part] % high).astype(np.float32)[:, None]
            result[rows[part]] = texture.sample(*at, level)[:, 0] * faces.tint[face[part]]
    known = scan.face >= 0
    leaf = (scan.face < 0) & (scan.object_id >= TREE_ID) & (scan.object_id < TREE_ID + 10_000)
    tints = np.zeros((int(max(today.ellipsoids.object_id.max(), TREE_ID)) + 1, 3))
    tints[today.ellipsoids.object_id] = today.ellipsoids.tint
    result[leaf] = _LEAVES_RGB * tints[scan.object_id[leaf]] * 0.9
    return np.clip(result, 0, 255), known | leaf


def kinds_of(scene: Scene, today: Scene, scan: AirborneScan) -> dict[str, NDArray[np.bool_]]:
    """What was hit, and from where it is seen."""
    normal = np.cross(today.faces.edge_s, today.faces.edge_t)
    upright = np.abs(normal[:, 2]) < 0.2 * np.linalg.norm(normal, axis=1)
    hard = scan.face >= 0
    wall = hard & upright[scan.face]
    building = (scan.object_id >= BUILDING_ID) & (scan.object_id < TREE_ID)
    crowns = scene.ellipsoids
    under = np.zeros(len(scan), dtype=bool)
    ground = hard & np.isin(today.faces.texture[scan.face], [TEXTURES.index(n) for n in ("ground", "fields")])
    rows = np.flatnonzero(ground)
    for center, radii in zip(crowns.center, crowns.radii, strict=True):
        near = np.hypot(*(scan.xyz[rows, :2] - center[:2]).T) < radii[0]
        under[rows[near]] = True
    return {
        "open ground": ground & ~under,
        "ground under crowns": under,
        "roofs": building & hard & ~wall,
        "walls": building & wall,
        "leaves": (scan.object_id >= TREE_ID) & ~hard & ~scan.outlier,
        "all": np.ones(len(scan), dtype=bool),
    }


def row_of(
    kind: str, rows: NDArray[np.bool_], coloured: NDArray[np.bool_], error: NDArray[np.float64]
) -> Row:
    n, taken = int(rows.sum()), rows & coloured
    found = error[taken]
    return Row(
        kind=kind,
        points=n,
        coloured=taken.sum() / max(n, 1),
        wrong_of_coloured=float((found > _WRONG).mean()) if len(found) else 0.0,
        median_error=float(np.median(found)) if len(found) else 0.0,
    )


def print_table(rows: list[Row]) -> None:
    print(f"{'':22}{'points':>10}{'coloured':>10}{'wrong':>9}{'median error':>14}")
    for row in rows:
        print(
            f"{row.kind:22}{row.points:>10}{row.coloured:>10.1%}{row.wrong_of_coloured:>9.1%}{row.median_error:>14.1f}"
        )


def plan_view(
    scan: AirborneScan, rows: NDArray[np.bool_], rgb: NDArray[np.uint8], cell_m: float = 0.5
) -> NDArray[np.uint8]:
    """The points from above, the highest on top, black where there are none."""
    at = np.floor((scan.xyz[:, :2] - scan.xyz[:, :2].min(axis=0)) / cell_m).astype(int)
    width, height = at.max(axis=0) + 1
    image = np.zeros((height, width, 3), np.uint8)
    order = np.argsort(scan.xyz[:, 2])
    order = order[rows[order]]
    image[height - 1 - at[order, 1], at[order, 0]] = rgb[order]
    return image


if __name__ == "__main__":
    main()
