"""Street maps on a scan's outlines: a made street is found within its covariance, its mirror image is not."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from featuredb.geometry.sim3 import point_jacobian
from featuredb.render.cloud import PointCloud
from featuredb.simworld.camera.photograph import look_pose
from ingest.register.anchor.ground import place
from ingest.register.anchor.ground.place import place_on_outlines
from ingest.register.anchor.ground.search import Geotags
from ingest.register.anchor.ground.street_plan import halves, looks_level, weakest_cut
from tests.support.scanned_map import plain_cloud
from tests.support.street_map import OWN_FROM_LOCAL, few_sizes, joined_wrongly, street_map, street_scan


@pytest.fixture(scope="module", autouse=True)
def _few_sizes() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        few_sizes(patch)
        yield


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    return plain_cloud(street_scan())


def test_a_street_is_found_within_its_covariance(cloud: PointCloud) -> None:
    unplaced = street_map(mirrored=False)
    assert looks_level(unplaced)
    found = place_on_outlines(unplaced, cloud)
    assert found.reason is None, found.message
    assert found.local_from_own is not None
    assert found.covariance is not None
    assert len(found.image_ids) == 16
    truth = OWN_FROM_LOCAL.inverse()
    for image in unplaced.images:
        there = found.local_from_own.act(image.cam_from_local.center)
        off = there - truth.act(image.cam_from_local.center)
        jacobian = point_jacobian(there)
        assert np.linalg.norm(off) < 0.3
        assert off @ np.linalg.solve(jacobian @ found.covariance @ jacobian.T, off) < chi2.isf(1e-3, 3)


def test_look_alikes_are_parted_where_they_were_joined() -> None:
    street = street_map(mirrored=False)
    joined = joined_wrongly(street)
    assert weakest_cut(joined)[1] < 0.5 * weakest_cut(street)[1]
    first, second = halves(joined)
    sides = [{image.image_id // 16 for image in part.images} for part in (first, second)]
    assert sides in ([{0}, {1}], [{1}, {0}])


def test_its_mirror_image_is_refused(cloud: PointCloud) -> None:
    found = place_on_outlines(street_map(mirrored=True), cloud)
    assert found.reason in ("STRUCTURE", "AMBIGUOUS", "TOO_FEW_FRAMES"), found.message


def test_it_is_refused_on_another_scan(cloud: PointCloud) -> None:
    xyz = cloud.xyz.astype(np.float64)
    turned = plain_cloud(np.column_stack([xyz[:, 1] * 0.8 + 9.0, -xyz[:, 0] * 1.3, xyz[:, 2]]))
    found = place_on_outlines(street_map(mirrored=False), turned)
    assert found.reason in ("STRUCTURE", "AMBIGUOUS", "TOO_FEW_FRAMES"), found.message


def test_cameras_are_no_higher_than_people_hold_them(
    cloud: PointCloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The points of the map that is found, seen from six metres higher."""
    street = street_map(mirrored=False)
    up = OWN_FROM_LOCAL.scale * OWN_FROM_LOCAL.rotation @ [0.0, 0.0, 6.0]
    images = []
    for image in street.images:
        pose = image.cam_from_local
        raised = replace(pose, translation=pose.translation - pose.rotation @ up)
        images.append(replace(image, cam_from_local=raised))
    raised_street = replace(street, images=tuple(images))
    assert place_on_outlines(raised_street, cloud).reason is not None
    monkeypatch.setattr(place, "_HIGHEST_M", 20.0)
    assert place_on_outlines(raised_street, cloud).reason is None


def test_geotags_say_how_likely_a_place_is_and_a_wrong_one_no_more_than_it_can() -> None:
    xy = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 5.0]])
    tags = Geotags(rows=np.array([0, 2, 3]), xy=xy, sigma_m=np.full(3, 10.0))
    there = np.vstack([xy[:1], [[99.0, 99.0]], xy[1:]])  # the second photo tells nothing
    near, off, lost = (
        tags.log_likelihood(there + shift) for shift in ([3.0, 0.0], [30.0, 0.0], [3000.0, 0.0])
    )
    assert near > -0.1
    assert off == pytest.approx(-0.5 * 3 * 4.0)  # thirty metres are two of fifteen
    one_wrong = there + np.array([[0.0, 0.0]] * 3 + [[500.0, 0.0]])
    assert tags.log_likelihood(one_wrong) == pytest.approx(lost / 3.0)


def test_photos_that_look_down_are_not_asked() -> None:
    street = street_map(mirrored=False)
    centers = [image.cam_from_local.center for image in street.images]
    down = [
        replace(image, cam_from_local=look_pose(center, 20.0 * k, -85.0))
        for k, (image, center) in enumerate(zip(street.images, centers, strict=True))
    ]
    assert not looks_level(replace(street, images=tuple(down)))
