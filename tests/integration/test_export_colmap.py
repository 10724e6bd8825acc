"""A map as COLMAP reads it: same pixels, same residuals, same poses, and a photo localised by it alone."""

import csv
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from pyproj import Transformer

from featuredb.errors import ExportError
from featuredb.export.formats.colmap import keypoint_rows, write_colmap
from featuredb.export.job import ExportJob
from featuredb.export.selection import Selection
from featuredb.features.extractor import extract
from featuredb.geometry.rigid3 import Rigid3
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from reloc.localise.localise import localise
from reloc.localise.result import LocaliseRequest
from tests.support import planar_map as field
from tests.support.scanned_map import scanned_map
from tests.support.scenes import indexed


@pytest.fixture(scope="module")
def field_map() -> FeatureMap:
    """A map whose every fourth keypoint has lost its descriptor, of photos of two people."""
    feature_map = field.planar_map(map_id="field/1")
    seen = feature_map.observations
    kept = np.arange(len(seen)) % 4 != 1
    images = tuple(
        replace(
            image,
            owner="Ann" if k % 2 else "Bob",
            licence="CC-BY-4.0" if k % 2 else "all rights reserved",
            capture_time=datetime(2026, 5, 1, 12, k, tzinfo=UTC),
        )
        for k, image in enumerate(feature_map.images)
    )
    return replace(
        feature_map,
        images=images,
        observations=replace(
            seen, has_descriptor=kept, descriptors=np.where(kept[:, None], seen.descriptors, np.uint8(0))
        ),
    )


def job_of(tmp_path: Path, *maps: FeatureMap, selection: Selection | None = None) -> ExportJob:
    database = Database.create(tmp_path / "maps.db")
    database.commit_maps(list(maps))
    return ExportJob(
        database=database,
        snapshot=database.snapshot(),
        selection=selection or Selection(),
        out=tmp_path / "out",
    )


def colmap_residuals(model: Any) -> dict[tuple[int, int], np.ndarray]:
    """Observed minus projected, by image id and row of its keypoints, all by COLMAP's own code."""
    found = {}
    for image_id, image in model.images.items():
        for row, point2d in enumerate(image.points2D):
            assert point2d.has_point3D()
            projected = image.project_point(model.point3D(point2d.point3D_id).xyz)
            found[image_id, row] = point2d.xy - projected
    return found


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("make", ["field", "ground"])
def test_colmap_sees_the_residuals_that_we_see(
    tmp_path: Path, field_map: FeatureMap, make: str, text: bool
) -> None:
    """Two lenses, distortion, 0.3 px of noise: each residual agrees to 1e-6 px, each pose to 1e-9 m."""
    feature_map = field_map if make == "field" else scanned_map(points=200).feature_map
    done = write_colmap(job_of(tmp_path, feature_map), text=text)
    folder = tmp_path / "out" / ("field%2F1" if make == "field" else "scanned")
    model = pycolmap.Reconstruction(str(folder / "sparse"))
    assert (folder / "sparse" / ("images.txt" if text else "images.bin")).is_file()
    assert (done.images, done.points, done.observations) == (
        model.num_reg_images(), model.num_points3D(), model.compute_num_observations(),
    )  # fmt: skip
    theirs = colmap_residuals(model)
    seen, keypoints = feature_map.observations, keypoint_rows(feature_map)
    local = feature_map.points_local()
    by_id = {image.image_id: image for image in feature_map.images}
    for row in range(len(seen)):
        image = by_id[int(seen.image_id[row])]
        point = image.cam_from_local.act(local[seen.point_index[row]])
        ours = seen.xy[row] - feature_map.cameras[image.camera_id].project(point)[0]
        key = (image.image_id + 1, int(keypoints.point2d[row]))
        np.testing.assert_allclose(theirs.pop(key), ours, atol=1e-6)
    assert theirs == {}
    for image in feature_map.images:
        stored = model.image(image.image_id + 1)
        assert stored.name == image.name
        np.testing.assert_allclose(stored.projection_center(), image.cam_from_local.center, atol=1e-9)


def test_the_database_holds_the_keypoints_of_the_model(tmp_path: Path, field_map: FeatureMap) -> None:
    write_colmap(job_of(tmp_path, field_map))
    folder = tmp_path / "out" / "field%2F1"
    model = pycolmap.Reconstruction(str(folder / "sparse"))
    told = {i["image_id"]: i for i in json.loads((folder / "georeference.json").read_text())["images"]}
    seen, keypoints = field_map.observations, keypoint_rows(field_map)
    database = pycolmap.Database.open(str(folder / "database.db"))
    try:
        assert database.num_images() == len(field_map.images)
        for image, rows in zip(field_map.images, keypoints.rows, strict=True):
            image_id = image.image_id + 1
            assert database.read_image(image_id).name == model.image(image_id).name == image.name
            found = database.read_keypoints(image_id)
            np.testing.assert_array_equal(found[:, :2], [p.xy for p in model.image(image_id).points2D])
            np.testing.assert_array_equal(found[:, 2] * 2, seen.scale[rows])
            np.testing.assert_allclose(np.degrees(found[:, 3]), seen.angle[rows], atol=1e-4)
            descriptors = database.read_descriptors(image_id)
            assert descriptors.type == pycolmap.FeatureExtractorType.SIFT
            np.testing.assert_array_equal(descriptors.data, seen.descriptors[rows])
            described = told[image_id]["descriptors"]
            assert 0 < described < len(rows)
            assert descriptors.data[:described].any(axis=1).all()
            assert not descriptors.data[described:].any()
            camera = database.read_camera(database.read_image(image_id).camera_id)
            np.testing.assert_array_equal(camera.params, field_map.cameras[image.camera_id].params)
    finally:
        database.close()


def test_the_place_on_earth_is_told(tmp_path: Path, field_map: FeatureMap) -> None:
    """From the model's coordinates to UTM by the matrix, and by the pipeline, both of PROJ alone."""
    write_colmap(job_of(tmp_path, field_map))
    folder = tmp_path / "out" / "field%2F1"
    place = json.loads((folder / "georeference.json").read_text())
    model = pycolmap.Reconstruction(str(folder / "sparse"))
    xyz = np.array([model.point3D(i + 1).xyz for i in range(len(field_map.points))])
    ecef = np.column_stack([xyz, np.ones(len(xyz))]) @ np.array(place["frame"]["ecef_from_local"]).T
    to_utm = Transformer.from_crs("EPSG:4978", f"EPSG:{place['utm']['epsg']}", always_xy=True)
    plane = np.column_stack(to_utm.transform(*ecef[:, :3].T))
    np.testing.assert_allclose(plane[:, :2], field_map.points.utm[:, :2], atol=1e-5)
    whole = np.column_stack(Transformer.from_pipeline(place["utm"]["pipeline"]).transform(*xyz.T))
    np.testing.assert_allclose(whole, field_map.points.utm, atol=1e-5)
    assert place["crs"]["height_datum"] == "ellipsoidal"
    assert place["crs"]["utm"] == "EPSG:32632"


def test_a_photo_is_localised_by_colmap_alone(tmp_path: Path, field_map: FeatureMap) -> None:
    """Matches of a new photo's features to the exported database and model, pose by COLMAP: 2 cm off ours."""
    write_colmap(job_of(tmp_path, field_map))
    folder = tmp_path / "out" / "field%2F1"
    truth = field.view(4.0, -6.0, 41.0, 9.0, 25.0)
    photo = field.render(field.field_texture(1), truth, seed=77)
    ours = localise(photo, LocaliseRequest(camera=field.CAMERA), [indexed(field_map)])
    assert ours.pose is not None
    features = extract(photo)
    theirs = localised_by_colmap(folder, features.xy, features.descriptors, field.CAMERA.to_pycolmap())
    here_from_area = field_map.frame.enu_from(ours.pose.frame)
    ours_center = here_from_area.act(ours.pose.cam_from_local.center)
    assert np.linalg.norm(theirs.center - ours_center) < 0.02
    assert np.linalg.norm(theirs.center - truth.center) < 0.03
    assert theirs.angle_to_deg(ours.pose.cam_from_local @ here_from_area.inverse()) < 0.05


def test_colmap_finds_its_own_features_in_the_exported_database(
    tmp_path: Path, field_map: FeatureMap
) -> None:
    """The whole of it by COLMAP, SIFT and matching included: the stored descriptors are what it expects."""
    write_colmap(job_of(tmp_path, field_map))
    truth = field.view(-5.0, 3.0, 43.0, 7.0, 15.0)
    photo = field.render(field.field_texture(1), truth, seed=78)
    cv2.imwrite(str(tmp_path / "new.png"), photo)
    theirs = sought_by_colmap(tmp_path / "out" / "field%2F1", tmp_path / "new.png")
    ours = localise(photo, LocaliseRequest(camera=field.CAMERA), [indexed(field_map)])
    assert ours.pose is not None
    map_from_area = field_map.frame.enu_from(ours.pose.frame)
    center = map_from_area.act(ours.pose.cam_from_local.center)
    assert np.linalg.norm(theirs.center - center) < 0.05
    assert np.linalg.norm(theirs.center - truth.center) < 0.05


def sought_by_colmap(folder: Path, photo: Path) -> Rigid3:
    """cam_from_world of a photo of the model's first camera, by COLMAP's own features, matches and pose."""
    model, file = pycolmap.Reconstruction(str(folder / "sparse")), folder.with_name("with_photo.db")
    shutil.copy(folder / "database.db", file)
    reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reader.existing_camera_id, extraction.max_image_size = 1, 1600
    pycolmap.extract_features(
        str(file), str(photo.parent), image_names=[photo.name], camera_mode=pycolmap.CameraMode.AUTO,
        reader_options=reader, extraction_options=extraction,
    )  # fmt: skip
    listed, pairing = folder.with_name("pairs.txt"), pycolmap.ImportedPairingOptions()
    listed.write_text("".join(f"{photo.name} {image.name}\n" for image in model.images.values()))
    pairing.match_list_path = str(listed)
    pycolmap.match_image_pairs(str(file), pairing_options=pairing)
    database = pycolmap.Database.open(str(file))
    try:
        query = database.read_image_with_name(photo.name).image_id
        pixels = database.read_keypoints(query)[:, :2].astype(np.float64)
        seen = {
            (int(mine), int(image.points2D[int(theirs)].point3D_id))
            for image_id, image in model.images.items()
            if database.exists_two_view_geometry(query, image_id)
            for mine, theirs in database.read_two_view_geometry(query, image_id).inlier_matches
            if image.points2D[int(theirs)].has_point3D()
        }
    finally:
        database.close()
    rows, points = np.array(sorted(seen)).T
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.random_seed = 4.0, 0
    found = pycolmap.estimate_and_refine_absolute_pose(
        pixels[rows], np.array([model.point3D(i).xyz for i in points]), model.camera(1), options
    )
    assert found is not None
    return Rigid3.from_matrix(found["cam_from_world"].matrix())


def localised_by_colmap(folder: Path, xy: np.ndarray, descriptors: np.ndarray, camera: Any) -> Rigid3:
    """cam_from_world by what is in the exported folder, NumPy and pycolmap."""
    model = pycolmap.Reconstruction(str(folder / "sparse"))
    database = pycolmap.Database.open(str(folder / "database.db"))
    described, points = [], []
    try:
        for image_id, image in sorted(model.images.items()):
            data = database.read_descriptors(image_id).data
            rows = np.flatnonzero(data.any(axis=1))
            described.append(data[rows])
            points.append([image.points2D[r].point3D_id for r in rows])
    finally:
        database.close()
    known, ids = np.concatenate(described).astype(np.float32), np.concatenate(points)
    similarity = descriptors.astype(np.float32) @ known.T
    best = similarity.argmax(axis=1)
    of_others = np.where(ids[None] == ids[best][:, None], -np.inf, similarity).max(axis=1)
    distance = np.arccos(np.clip(similarity.max(axis=1) / 512**2, -1, 1))
    good = distance < 0.8 * np.arccos(np.clip(of_others / 512**2, -1, 1))
    found = pycolmap.estimate_and_refine_absolute_pose(
        xy[good].astype(np.float64), np.array([model.point3D(i).xyz for i in ids[best[good]]]), camera
    )
    assert found is not None
    return Rigid3.from_matrix(found["cam_from_world"].matrix())


def test_the_same_map_gives_the_same_bytes(tmp_path: Path, field_map: FeatureMap) -> None:
    job = job_of(tmp_path, field_map)
    digests = []
    for name in ("a", "b"):
        write_colmap(replace(job, out=tmp_path / name))
        files = sorted(f for f in (tmp_path / name).rglob("*") if f.is_file())
        digests.append(
            [(f.relative_to(tmp_path / name), hashlib.sha256(f.read_bytes()).digest()) for f in files]
        )
    assert digests[0] == digests[1]
    assert len(digests[0]) == 8


def test_only_what_the_licence_allows_goes_out(tmp_path: Path, field_map: FeatureMap) -> None:
    job = job_of(tmp_path, field_map, selection=Selection(licences=("cc-by",)))
    done = write_colmap(job)
    folder = tmp_path / "out" / "field%2F1"
    with (folder / "attribution.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    model = pycolmap.Reconstruction(str(folder / "sparse"))
    wanted = [image for image in field_map.images if image.owner == "Ann"]
    assert [row["image"] for row in rows] == [image.name for image in wanted]
    assert {row["image"] for row in rows} == {image.name for image in model.images.values()}
    assert {(row["owner"], row["licence"]) for row in rows} == {("Ann", "CC-BY-4.0")}
    assert [row["sha256"] for row in rows] == [image.sha256 for image in wanted]
    assert done.images == len(wanted) == 4
    assert done.observations < len(field_map.observations) / 2
    assert min(len(p.track.elements) for p in model.points3D.values()) >= 2
    with pytest.raises(ExportError, match="found none in the"):
        write_colmap(replace(job, selection=Selection(licences=("cc0",)), out=tmp_path / "none"))
    assert not list(tmp_path.glob("*none*"))


def test_names_that_repeat_are_told_apart(tmp_path: Path, field_map: FeatureMap) -> None:
    images = tuple(replace(i, name="a.jpg" if i.image_id < 2 else i.name) for i in field_map.images)
    write_colmap(job_of(tmp_path, replace(field_map, images=images)))
    folder = tmp_path / "out" / "field%2F1"
    model = pycolmap.Reconstruction(str(folder / "sparse"))
    assert [model.image(i).name for i in (1, 2, 3)] == ["1/a.jpg", "2/a.jpg", "2.png"]
    told = json.loads((folder / "georeference.json").read_text())["images"]
    assert [i["original_name"] for i in told][:2] == ["a.jpg", "a.jpg"]


_KILLED = """
import os, signal, sys
from pathlib import Path
from featuredb.export.formats import colmap
from featuredb.export.job import ExportJob
from featuredb.export.selection import Selection
from featuredb.store import Database
database = Database.open(sys.argv[1])
def told(done, total):
    print(done, total, sorted(p.name for p in Path(sys.argv[2]).parent.iterdir()), flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
colmap.write_colmap(ExportJob(database=database, snapshot=database.snapshot(), selection=Selection(),
                              out=Path(sys.argv[2]), told=told))
"""


def test_a_kill_in_the_middle_leaves_nothing(tmp_path: Path, field_map: FeatureMap) -> None:
    job = job_of(tmp_path, field_map, replace(field_map, map_id="second"))
    work = tmp_path / "work"
    work.mkdir()
    died = subprocess.run(
        [sys.executable, "-c", _KILLED, str(tmp_path / "maps.db"), str(work / "out")],
        capture_output=True, text=True, timeout=120, check=False, env=os.environ,
    )  # fmt: skip
    assert died.returncode == -signal.SIGKILL, died.stderr
    assert died.stdout.startswith("1 2 ['.out.part-")
    assert not (work / "out").exists()
    assert write_colmap(replace(job, out=work / "out")).maps == 2
    assert sorted(p.name for p in (work / "out").iterdir()) == ["field%2F1", "second"]
