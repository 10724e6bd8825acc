"""Street views: free places on a scan's ground, photos drawn over it, a map that street photos find."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError, RegistrationError
from featuredb.features.extractor import ExtractorOptions
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.index.area import build_area
from featuredb.index.descriptor_index import build_index
from featuredb.maps.feature_map import FeatureMap, MapImage, MapObservations, MapPoints, Placement
from featuredb.render.cloud import GROUND, PointCloud
from featuredb.render.levels import build_cloud
from featuredb.simworld.shot import look_pose
from ingest.street.stand import StandOptions, standing_places, views_around
from ingest.street.street_map import StreetOptions, street_map
from ingest.street.synthesis import source_photo, surfaces_of_scan, synthesise
from reloc.candidates import IndexedArea
from reloc.localise import localise
from reloc.result import LocaliseRequest
from tests.support.planar_map import EASTING, EPSG, HEIGHT, NORTHING, field_texture

pytest.importorskip("numba")

_AIR = Camera(model="PINHOLE", width=800, height=600, params=(900.0, 900.0, 400.0, 300.0))
_STREET = Camera(model="PINHOLE", width=640, height=480, params=(480.0, 480.0, 320.0, 240.0))
_FRAME = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
_TEXEL_M = 0.04
_HIGH_M = 12.0


def wall_and_ground() -> PointCloud:
    """A front of 40 x 12 m at north = 0 that looks south, on level ground; a point every 0.25 to 0.4 m."""
    rng = np.random.default_rng(2)
    e, u = (v.ravel() for v in np.meshgrid(np.arange(-20, 20, 0.4), np.arange(0.2, _HIGH_M, 0.3)))
    wall = np.column_stack([e, rng.normal(0, 0.02, len(e)), u])
    e, n = (v.ravel() for v in np.meshgrid(np.arange(-25, 25, 0.25), np.arange(-30, 0, 0.25)))
    ground = np.column_stack([e, n, rng.normal(0, 0.02, len(e))])
    classes = np.concatenate([np.full(len(wall), 6), np.full(len(ground), GROUND)]).astype(np.uint8)
    return build_cloud(_FRAME, "ellipsoidal", np.vstack([wall, ground]), classification=classes)


def photo(camera: Camera, pose: Rigid3, seed: int = 0) -> NDArray[np.uint8]:
    """The textured front as a camera sees it, by intersecting each ray with it; all else is grey."""
    y, x = np.mgrid[: camera.height, : camera.width]
    flat = camera.unproject(np.column_stack([x.ravel() + 0.5, y.ravel() + 0.5]))
    rays = np.column_stack([flat, np.ones(len(flat))]) @ pose.rotation
    center = pose.center
    with np.errstate(divide="ignore", invalid="ignore"):
        far = -center[1] / rays[:, 1]
    met = center + rays * far[:, None]
    on_wall = (far > 0) & (np.abs(met[:, 0]) < 20) & (met[:, 2] > 0) & (met[:, 2] < _HIGH_M)
    texture = cv2.GaussianBlur(field_texture(3), (0, 0), 1.0)
    column = ((met[:, 0] + 20.0) / _TEXEL_M).astype(np.float32).reshape(y.shape)
    row = ((_HIGH_M - met[:, 2]) / _TEXEL_M).astype(np.float32).reshape(y.shape)
    seen = cv2.remap(texture, column, row, cv2.INTER_LINEAR).astype(np.float64)
    noise = np.random.default_rng(seed).normal(0, 1.5, y.shape)
    grey = np.where(on_wall.reshape(y.shape), seen, 110.0) + noise
    return np.asarray(np.clip(grey, 0, 255), dtype=np.uint8)


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    return wall_and_ground()


@pytest.fixture(scope="module")
def aerial(cloud: PointCloud) -> FeatureMap:
    """A map of four oblique photos, 45 degrees down from 35 m; its own points do not matter here."""
    poses = [look_pose((e, -32.0, 38.0), -0.6 * e, -42.0) for e in (-18.0, -6.0, 6.0, 18.0)]
    points = np.array([(e, n, 0.0) for e in (-10, 0, 8) for n in (-22, -17, -11)], dtype=np.float64)
    n = len(points)
    return FeatureMap(
        map_id="aerial", name="aerial", epsg=EPSG, height_datum="ellipsoidal", frame=cloud.frame,
        cameras=(_AIR,),
        images=tuple(
            MapImage(image_id=k, name=f"{k}.png", sha256=f"{k:064x}", camera_id=0, cam_from_local=pose)
            for k, pose in enumerate(poses)
        ),
        points=MapPoints(
            utm=cloud.frame.utm_from_enu(points, EPSG), rgb=np.zeros((n, 3), np.uint8),
            track_length=np.zeros(n, np.int32), error_px=np.zeros(n, np.float32),
            covariance=np.zeros((n, 6), np.float32),
        ),
        observations=MapObservations(
            point_index=np.zeros(0, np.int64), image_id=np.zeros(0, np.int32),
            xy=np.zeros((0, 2), np.float32),
            scale=np.zeros(0, np.float32), angle=np.zeros(0, np.float32),
            has_descriptor=np.zeros(0, np.bool_),
            descriptors=np.zeros((0, 128), np.uint8),
        ),
        placement=Placement(method="lidar", local_from_sfm=Sim3.identity(), covariance=np.eye(7) * 1e-6,
                            residual_rms_m=0.03),
        extractor_fingerprint=ExtractorOptions().fingerprint,
    )  # fmt: skip


def test_a_drawn_view_is_what_a_camera_there_would_see(cloud: PointCloud, aerial: FeatureMap) -> None:
    sources = [
        source_photo(cloud, photo(_AIR, i.cam_from_local), _AIR, i.cam_from_local) for i in aerial.images
    ]
    pose = look_pose((2.0, -14.0, 1.6), 8.0, 10.0)
    view = synthesise(surfaces_of_scan(cloud), _STREET, pose, sources)
    truth = photo(_STREET, pose)
    on_wall = view.drawn & (np.abs(view.points[..., 1]) < 0.3) & (view.points[..., 2] > 0.5)
    assert on_wall.sum() > 0.5 * view.drawn.size
    blurred = cv2.GaussianBlur(truth, (0, 0), 3.0).astype(np.float64)  # the aerial photos are that coarse
    drawn = cv2.GaussianBlur(view.gray, (0, 0), 2.0).astype(np.float64)
    assert np.corrcoef(drawn[on_wall], blurred[on_wall])[0, 1] > 0.9
    assert np.abs(view.points[on_wall][:, 1]).mean() < 0.04


def test_a_photo_from_the_street_is_localised(cloud: PointCloud, aerial: FeatureMap) -> None:
    options = StreetOptions(stand=StandOptions(step_m=10.0, headings=3))
    made = street_map(aerial, cloud, lambda i: photo(_AIR, i.cam_from_local), options)
    assert made.status == "quarantined"
    assert made.parents == ("aerial",)
    assert made.placement.method == "map"
    area = build_area([made])
    indexed = [IndexedArea(area=area, index=build_index(area.descriptors))]
    true = look_pose((-3.0, -16.0, 1.6), -10.0, 9.0)
    found = localise(photo(_STREET, true, seed=7), LocaliseRequest(camera=_STREET), indexed)
    assert found.pose is not None, found.detail
    pose = found.pose.cam_from_local @ found.pose.frame.enu_from(cloud.frame)
    assert np.linalg.norm(pose.center - true.center) < 0.15
    assert pose.angle_to_deg(true) < 0.5
    elsewhere = np.flip(photo(_STREET, true, seed=7), axis=1).copy()
    assert localise(elsewhere, LocaliseRequest(camera=_STREET), indexed).pose is None


def test_places_stand_on_free_ground(cloud: PointCloud) -> None:
    box = np.array([-24.0, -29.0]), np.array([24.0, -1.0])
    post = np.array([[0.5, -14.5, z] for z in np.arange(0.6, 2.0, 0.2)])
    with_post = build_cloud(
        cloud.frame,
        "ellipsoidal",
        np.vstack([cloud.xyz, post]),
        classification=np.concatenate([cloud.classification, np.full(len(post), 1, np.uint8)]),
    )
    places = standing_places(with_post, *box, StandOptions(step_m=4.0))
    assert len(places) == 12 * 7
    np.testing.assert_allclose(places[:, 2], 1.6, atol=0.03)
    assert np.hypot(*(places[:, :2] - [0.5, -14.5]).T).min() > 1.0
    low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0)
    assert (low > box[0]).all()
    assert (high < box[1]).all()


def test_a_scan_without_ground_is_refused(cloud: PointCloud) -> None:
    bare = replace(cloud, classification=np.ones(len(cloud), np.uint8))
    with pytest.raises(RegistrationError, match="classify the scan"):
        standing_places(bare, np.array([-20.0, -20.0]), np.array([20.0, 0.0]))


def test_views_look_around_from_one_place() -> None:
    place: FloatArray = np.array([3.0, -4.0, 1.6])
    poses = views_around(place, StandOptions(headings=4, pitch_deg=8.0))
    for pose, ahead in zip(poses, ([0, 1], [1, 0], [0, -1], [-1, 0]), strict=True):
        np.testing.assert_allclose(pose.center, place, atol=1e-12)
        forward = pose.rotation[2]
        np.testing.assert_allclose(forward[:2] / np.linalg.norm(forward[:2]), ahead, atol=1e-12)
        assert np.degrees(np.arcsin(forward[2])) == pytest.approx(8.0)
        assert pose.rotation[1] @ [0, 0, 1] < 0, "the picture's bottom is down"


def test_another_extractor_than_the_map_is_refused(cloud: PointCloud, aerial: FeatureMap) -> None:
    options = StreetOptions(extractor=ExtractorOptions(upright=True))
    with pytest.raises(InvalidValueError, match="extractor"):
        street_map(aerial, cloud, lambda i: photo(_AIR, i.cam_from_local), options)
