"""Parts of anchoring: ranking, moves and residuals of maps, edges and pages, proposals on disk."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from featuredb.errors import RegistrationError
from featuredb.geometry.camera import Camera
from featuredb.geometry.camera_angles import cam_from_enu
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap
from featuredb.render.cloud import PointCloud
from ingest.register.anchor.files import load_proposals, save_proposals
from ingest.register.anchor.frames import TriedFrames
from ingest.register.anchor.page import anchor_page, edges_of, scan_view
from ingest.register.anchor.proposals import propose_frames, small_camera
from ingest.register.anchor.report import AnchorReport
from ingest.register.block import block_of_map
from ingest.register.frame_registration import FramePrior, FrameRegistration
from ingest.register.structure.surface_fit import map_move, map_residuals, median_m
from tests.support.clouds import build_cloud
from tests.support.maps import random_map

CAMERA = Camera(model="SIMPLE_RADIAL", width=800, height=600, params=(700.0, 400.0, 300.0, 0.0))


def down(east: float, north: float, up: float = 50.0, pitch_deg: float = -90.0) -> Rigid3:
    rotation = cam_from_enu(0.0, pitch_deg, 0.0)
    return Rigid3(rotation=rotation, translation=-rotation @ np.array([east, north, up]))


def town(feature_map: FeatureMap) -> PointCloud:
    """Flat ground of 80 m by 80 m with one block of 10 m, white on its roof."""
    steps = np.arange(-40.0, 40.0, 0.25)
    east, north = (g.ravel() for g in np.meshgrid(steps, steps))
    roof = (np.abs(east) < 8) & (np.abs(north) < 6)
    grey = np.where(roof, 230, np.where((north > 20) & (north < 24), 180, 60)).astype(np.uint8)
    xyz = np.column_stack([east, north, np.where(roof, 10.0, 0.0)])
    return build_cloud(feature_map.frame, "egm96", xyz, rgb=np.repeat(grey[:, None], 3, axis=1))


def seeing_map(poses: list[Rigid3]) -> FeatureMap:
    """A map whose images see random ground points, each in every image that has it inside."""
    base = random_map(5, points=300, images=len(poses), extent_m=60.0)
    points = base.points_local()
    points[:, 2] = 0.0
    images, index, ids, xy = [], [], [], []
    for image, pose in zip(base.images, poses, strict=True):
        pixels = CAMERA.project(pose.act(points))
        inside = ((pixels > 0) & (pixels < [800, 600])).all(axis=1)
        images.append(replace(image, camera_id=0, cam_from_local=pose))
        index.append(np.flatnonzero(inside))
        ids.append(np.full(int(inside.sum()), image.image_id, np.int32))
        xy.append(pixels[inside])
    m = sum(len(i) for i in index)
    observations = replace(
        base.observations,
        point_index=np.concatenate(index),
        image_id=np.concatenate(ids),
        xy=np.concatenate(xy).astype(np.float32),
        scale=np.ones(m, np.float32),
        angle=np.zeros(m, np.float32),
        has_descriptor=np.zeros(m, bool),
        descriptors=np.zeros((m, 128), np.uint8),
    )
    return replace(
        base,
        cameras=(CAMERA,),
        camera_keys=("",),
        images=tuple(images),
        points=replace(base.points, utm=base.frame.utm_from_enu(points, base.epsg)),
        observations=observations,
    )


def priors(feature_map: FeatureMap) -> dict[int, FramePrior]:
    return {
        image.image_id: FramePrior(
            cam_from_local=image.cam_from_local,
            sigma_horizontal_m=3.0,
            sigma_vertical_m=3.0,
            sigma_heading_deg=2.0,
            sigma_tilt_deg=2.0,
        )
        for image in feature_map.images
    }


def test_frames_that_see_more_of_the_scan_come_first_and_others_not_at_all() -> None:
    # Over the middle; beside the first; half beside the scan; far away; looking at the horizon.
    poses = [down(0, 0), down(2, 1), down(28, 0), down(300, 0), down(0, -30, 20.0, pitch_deg=-12.0)]
    feature_map = seeing_map(poses)
    ranked = propose_frames(feature_map, town(feature_map), priors(feature_map))
    ids = [p.image.image_id for p in ranked]
    assert 3 not in ids
    assert ids[0] in (0, 1)
    scores = {p.image.image_id: p for p in ranked}
    assert scores[0].coverage > 0.95 > scores[2].coverage > 0.5
    assert scores[0].downward > 0.9
    assert scores[2].score < scores[0].score
    # The neighbour of the first sees the same points; what it saw is held against it.
    assert ids.index(1 - ids[0]) > 0


def moved(feature_map: FeatureMap, move: Sim3) -> FeatureMap:
    utm = feature_map.frame.utm_from_enu(move.act(feature_map.points_local()), feature_map.epsg)
    images = tuple(replace(i, cam_from_local=move.act_on_pose(i.cam_from_local)) for i in feature_map.images)
    placed = replace(feature_map.placement, local_from_sfm=move @ feature_map.placement.local_from_sfm)
    return replace(feature_map, images=images, points=replace(feature_map.points, utm=utm), placement=placed)


def test_a_move_is_told_in_words_that_people_know() -> None:
    covariance = np.diag([1e-4, 1e-4, 1e-4, 4e-4, 4.0, 4.0, 100.0])
    old = random_map(4, points=500, extent_m=80.0)
    old = replace(old, placement=replace(old.placement, covariance=covariance))
    turn = np.radians(2.0)
    true = Sim3.exp([0.01, 0.0, 0.0, turn, 0.0, 0.0, 0.0])
    new = moved(old, true)
    middle = np.median(old.points_local(), axis=0)
    shift = true.act(middle) - middle
    move = map_move(old, new)
    assert move.heading_deg == pytest.approx(2.0, abs=1e-3)
    assert move.heading_sigmas == pytest.approx(turn / 0.02, rel=1e-3)
    assert move.scale == pytest.approx(np.exp(0.01), rel=1e-6)
    assert move.scale_sigmas == pytest.approx(1.0, rel=1e-3)
    assert move.tilt_deg == pytest.approx(0.0, abs=1e-6)
    assert move.horizontal_m == pytest.approx(np.hypot(*shift[:2]), abs=1e-6)


def test_residuals_compare_the_same_points_and_leave_out_holes() -> None:
    feature_map = seeing_map([down(0, 0)])
    cloud = town(feature_map)
    inside = (np.abs(feature_map.points_local()[:, :2]) < 36).all(axis=1)
    lifted = moved(feature_map, Sim3.exp([0, 0, 0, 0, 0, 0, -7.0]))
    before, after = map_residuals(lifted, feature_map, cloud)
    assert len(before) == len(after) >= inside.sum()
    assert median_m(after) < 0.15
    assert median_m(before) == pytest.approx(7.0, abs=0.05)
    far = moved(feature_map, Sim3.exp([0, 0, 0, 0, 500.0, 0, 0]))
    assert len(map_residuals(feature_map, far, cloud)[1]) == 0
    assert np.median(block_of_map(feature_map).distances()) == pytest.approx(54.0, abs=3.0)


def test_edges_lie_where_depth_and_colour_change_and_not_at_the_scans_border() -> None:
    feature_map = seeing_map([down(0, 0)])
    view = scan_view(town(feature_map), CAMERA, down(0.0, 0.0, 60.0))
    jump, value = edges_of(view)
    rows, columns = np.nonzero(jump)
    # The roof, 50 m below: 16 m by 12 m are 224 by 168 pixels around the middle.
    assert np.abs(columns - 400).max() < 130
    assert np.abs(rows - 300).max() < 100
    assert 500 < len(rows) < 3000
    # The light strip lies 20 m to 24 m north: its edges are at rows 20 and 66.7; points are 3 pixels apart.
    strip = np.nonzero(value[:100, 300:500])[0]
    far, near = np.abs(strip - 20.0), np.abs(strip - 66.7)
    assert np.minimum(far, near).max() < 4.0
    assert (far < 4.0).sum() > 150
    assert (near < 4.0).sum() > 150
    border = ~view.valid
    near_border = np.zeros_like(border)
    near_border[1:-1, 1:-1] = border[:-2, 1:-1] | border[2:, 1:-1] | border[1:-1, :-2] | border[1:-1, 2:]
    assert not (value & near_border).any()


def test_the_page_needs_no_network_and_escapes_names() -> None:
    feature_map = seeing_map([down(0, 0)])
    image = replace(feature_map.images[0], name="<b>.jpg")
    feature_map = replace(feature_map, images=(image,), name="Field & wood", cameras=(CAMERA,))
    tried = TriedFrames.of_registrations(feature_map, {image.image_id: registration()})
    report = AnchorReport(
        map_id="m",
        map_name=feature_map.name,
        database="db",
        photos="photos",
        scan_ids=("s",),
        epsg=feature_map.epsg,
        datum_before="unknown",
        datum_after="egm96",
        tried=tried,
        result=None,
    )
    photo = np.full((600, 800, 3), 120, np.uint8)
    text = anchor_page(report, feature_map, town(feature_map), lambda _: photo, "featuredb --confirm {image}")
    assert "http" not in text
    assert "<b>.jpg" not in text
    assert "featuredb --confirm &#x27;&lt;b&gt;.jpg&#x27;" in text
    assert "Anchoring of Field &amp; wood" in text
    assert text.count("data:image/jpeg;base64,") == 2
    assert text.count("data:image/png;base64,") == 1


def test_small_cameras_keep_the_picture() -> None:
    small = small_camera(
        Camera(model="PINHOLE", width=4000, height=2250, params=(2800, 2800, 2000, 1125)), 1280
    )
    assert (small.width, small.height) == (1280, 720)
    assert small.params == pytest.approx((896.0, 896.0, 640.0, 360.0))
    tiny = Camera(model="PINHOLE", width=90, height=60, params=(80, 80, 45, 30))
    assert small_camera(tiny, 200) == tiny


def registration() -> FrameRegistration:
    return FrameRegistration(
        cam_from_local=down(1, 2),
        covariance=np.eye(6) * 1e-4,
        reason=None,
        message="",
        camera=CAMERA,
        source="rgb",
        points_local=np.arange(12.0).reshape(4, 3),
        pixels=np.arange(8.0).reshape(4, 2),
        evidence={"inliers": 4},
        seconds={"look": 0.25},
    )


def test_proposals_read_back_exactly_and_only_for_the_same_state(tmp_path: Path) -> None:
    save_proposals(tmp_path, ("m", "w", "s"), {3: registration()})
    found = load_proposals(tmp_path, ("m", "w", "s"))[3]
    np.testing.assert_array_equal(found.pixels, registration().pixels)
    np.testing.assert_array_equal(found.points_local, registration().points_local)
    assert found.cam_from_local is not None
    np.testing.assert_array_equal(found.cam_from_local.matrix(), down(1, 2).matrix())
    assert found.camera == CAMERA
    assert (found.source, found.evidence, found.seconds) == ("rgb", {"inliers": 4}, {"look": 0.25})
    for other in (("n", "w", "s"), ("m", "v", "s"), ("m", "w", "t")):
        with pytest.raises(RegistrationError, match="run the command without --confirm again"):
            load_proposals(tmp_path, other)
    path = tmp_path / "proposals.json"
    path.write_text(path.read_text().replace('"source": "rgb"', '"source": null'))
    with pytest.raises(RegistrationError, match="propose anew"):
        load_proposals(tmp_path, ("m", "w", "s"))
    path.write_text("{}")
    with pytest.raises(RegistrationError, match="propose anew"):
        load_proposals(tmp_path, ("m", "w", "s"))
    with pytest.raises(RegistrationError, match="nothing has been proposed"):
        load_proposals(tmp_path / "nowhere", ("m", "w", "s"))
