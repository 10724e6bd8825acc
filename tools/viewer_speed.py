"""How fast the viewer draws: `python -m tools.viewer_speed [--points 1000000] [--gpu]`.

Makes a database of five maps side by side with random points in a square kilometre, opens its page in
Chromium, and prints the renderer, how long the page took to load, how long a frame with all points takes (the
median of twenty, each waited for by reading a pixel), and how often the view is drawn while it turns. The
page draws fewer points while a view moves that would otherwise be slow; the share at the end is printed.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from playwright.sync_api import Page

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage, MapObservations, MapPoints, Placement
from featuredb.store import Database
from reloc.viewer.scene import SceneOptions, build_scene
from tools.viewer_page import SOFTWARE_GL, open_page

_EPSG = 32632
_MAPS = 5
_PHOTOS = 200  # of each map
_FULL_FRAMES = """async () => {
  const viewer = await window.featuredb;
  const { stage } = viewer;
  const gl = stage.renderer.getContext();
  const pixel = new Uint8Array(4);
  const times = [];
  for (let k = 0; k < 22; k++) {
    const start = performance.now();
    stage.moved = false;
    stage.frame();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    times.push(performance.now() - start);
  }
  return times.slice(2);
}"""
_TURN = """async () => {
  const viewer = await window.featuredb;
  const { stage } = viewer;
  const gaps = [];
  let before = performance.now();
  const end = before + 6000;
  await new Promise((done) => {
    const step = (now) => {
      gaps.push(now - before);
      before = now;
      stage.space.position.applyAxisAngle({ x: 0, y: 0, z: 1 }, 0.01);
      stage.spaceControls.update();
      if (now < end) requestAnimationFrame(step);
      else done();
    };
    requestAnimationFrame(step);
  });
  return { gaps: gaps.slice(Math.floor(gaps.length / 3)), share: stage.share };
}"""
_RENDERER = """async () => {
  const gl = (await window.featuredb).stage.renderer.getContext();
  return gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info").UNMASKED_RENDERER_WEBGL);
}"""


def main() -> None:
    parser = argparse.ArgumentParser(description="How fast the viewer draws.")
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--gpu", action="store_true", help="Chromium's own choice, not software OpenGL")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        database = Database.create(Path(folder) / "speed.db")
        for number in range(_MAPS):
            database.commit_map(make_map(number, args.points // _MAPS))
        start = time.perf_counter()
        scene = build_scene(database, database.snapshot(), options=SceneOptions(points=args.points))
        print(f"read from the database in {time.perf_counter() - start:.1f} s")
        start = time.perf_counter()
        with open_page(database, scene, None, arguments=() if args.gpu else SOFTWARE_GL) as page:
            print(f"browser started and page loaded in {time.perf_counter() - start:.1f} s")
            measure(page)


def measure(page: Page) -> None:
    """Print the figures."""
    points = page.evaluate(
        "window.featuredb.then((v) => v.place.maps.reduce((sum, map) => sum + map.buffer.count, 0))"
    )
    browser = page.context.browser
    print(f"{points:,} points, {_MAPS * _PHOTOS} photos; Chromium {browser.version if browser else '?'}")
    print(f"renderer: {page.evaluate(_RENDERER)}")
    for view in ("plan", "space"):
        page.click(f"#view-{view}")
        times = page.evaluate(_FULL_FRAMES)
        print(f"{view}: {np.median(times):.0f} ms a frame with all points (slowest {max(times):.0f} ms)")
    turn = page.evaluate(_TURN)
    gap = float(np.median(turn["gaps"]))
    print(f"turning: {1000 / gap:.0f} frames a second, {100 * turn['share']:.0f} % of the points")


def make_map(number: int, points: int) -> FeatureMap:
    """Random points and nadir photos in a strip of 200 m by 1 km; nothing observes anything."""
    rng = np.random.default_rng(number)
    frame = LocalFrame(latitude_deg=49.0, longitude_deg=8.4, height_m=100.0)
    west, east = -500 + 200 * number, -300 + 200 * number
    local = rng.uniform([west, -500, 0], [east, 500, 30], (points, 3))
    down = np.diag([1.0, -1.0, -1.0])
    centers = rng.uniform([west, -500, 80], [east, 500, 90], (_PHOTOS, 3))
    images = tuple(
        MapImage(
            image_id=k,
            name=f"{number}/{k}.jpg",
            sha256=f"{number * _PHOTOS + k:064x}",
            camera_id=0,
            cam_from_local=Rigid3(rotation=down, translation=-down @ center),
        )
        for k, center in enumerate(centers)
    )
    empty = np.empty(0)
    return FeatureMap(
        map_id=f"map-{number}",
        name=f"map {number}",
        epsg=_EPSG,
        height_datum="ellipsoidal",
        frame=frame,
        cameras=(Camera.from_focal(4000, 3000, 3000.0),),
        images=images,
        points=MapPoints(
            utm=frame.utm_from_enu(local, _EPSG),
            rgb=rng.integers(0, 256, (points, 3), dtype=np.uint8),
            track_length=np.full(points, 3, np.int32),
            error_px=np.full(points, 0.5, np.float32),
            covariance=np.zeros((points, 6), np.float32),
        ),
        observations=MapObservations(
            point_index=empty.astype(np.int64),
            image_id=empty.astype(np.int32),
            xy=np.empty((0, 2), np.float32),
            scale=empty.astype(np.float32),
            angle=empty.astype(np.float32),
            has_descriptor=empty.astype(np.bool_),
            descriptors=np.empty((0, 128), np.uint8),
        ),
        placement=Placement(
            method="gps", local_from_sfm=Sim3.identity(), covariance=np.eye(7) * 1e-6, residual_rms_m=0.1
        ),
        extractor_fingerprint="none",
    )


if __name__ == "__main__":
    main()
