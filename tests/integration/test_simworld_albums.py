"""Albums on disk: files, tables, truth, EXIF; an interrupted one goes on; the same bytes again."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from featuredb.simworld.camera.photograph import render_view
from featuredb.simworld.flight import FlightOptions
from featuredb.simworld.world import read_truth
from ingest.photos.table import read_table
from tools.worlds.album import TABLE_FILE, read_facts, write_album
from tools.worlds.community import CommunityOptions, community_album
from tools.worlds.poison_world import POISONS, PoisonOptions, plan_poison, poison_places
from tools.worlds.walk_world import WalkOptions, plan_walk

FLIGHT = FlightOptions(lines=1, per_line=2, oblique=0, width=320, gps_error="rtk")
TINY = CommunityOptions(
    seed=6,
    town_size_m=(200.0, 180.0),
    flight=FLIGHT,
    photos=8,
    other_town=2,
    copies=2,
    indoor=1,
    portraits=1,
    sights=2,
    width=320,
    texel_m=0.25,
    pieces=2,
)


pytestmark = pytest.mark.evaluation  # worlds of studies


@pytest.fixture(scope="module")
def album(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_album(tmp_path_factory.mktemp("album"), TINY, partial(community_album, TINY), workers=1)


def test_the_table_names_every_contributed_photo(album: Path) -> None:
    facts = read_facts(album)
    contributed = sorted(name for name, fact in facts.items() if fact.kind != "survey")
    rows = [json.loads(line) for line in (album / TABLE_FILE).read_text().splitlines()]
    assert [row["path"] for row in rows] == contributed
    for row in rows:
        assert (album / row["path"]).exists()
        assert facts[row["path"]].owner == row["owner"]
    assert [row.name for row in read_table(album / TABLE_FILE).rows] == contributed


def test_truth_has_the_photos_of_the_town_and_no_others(album: Path) -> None:
    facts, truth = read_facts(album), read_truth(album)
    assert set(truth.images) == {name for name, fact in facts.items() if fact.home}
    assert {f.kind for f in facts.values() if not f.home} == {"other_town", "indoor", "portrait"}
    for name, image in truth.images.items():
        with Image.open(album / name) as photo:
            assert photo.size == (image.camera.width, image.camera.height)


def test_a_photo_shows_what_its_true_pose_sees(album: Path) -> None:
    """The town on its first day drawn again with the true camera; other cars and light, the same houses."""
    facts, truth = read_facts(album), read_truth(album)
    scene = TINY.scene("home/0/000")
    agreement = []
    for name, image in truth.images.items():
        if facts[name].kind not in ("drone", "street"):
            continue
        photo = cv2.imread(str(album / name), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        assert photo is not None
        drawn = cv2.cvtColor(
            render_view(scene, image.camera, image.cam_from_local, moment=1), cv2.COLOR_RGB2GRAY
        )
        # Gradients without their size: neither exposure nor the sun's height matters.
        a, b = (
            np.arctan2(cv2.Sobel(x, cv2.CV_32F, 0, 1), cv2.Sobel(x, cv2.CV_32F, 1, 0)) for x in (photo, drawn)
        )
        agreement.append(float(np.cos(a - b).mean()))
    assert len(agreement) == 8
    assert np.median(agreement) > 0.3  # unrelated pictures: below 0.1


def test_exif_says_what_the_table_says_or_nothing(album: Path) -> None:
    lines = {r["path"]: r for r in map(json.loads, (album / "table.jsonl").read_text().splitlines())}
    seen = set()
    for path, row in lines.items():
        with Image.open(album / path) as photo:
            exif = photo.getexif()
            gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
        seen.add((bool(exif), bool(gps)))
        if gps:
            latitude = sum(float(v) / 60**i for i, v in enumerate(gps[ExifTags.GPS.GPSLatitude]))
            sign = 1 if gps[ExifTags.GPS.GPSLatitudeRef] == "N" else -1
            assert sign * latitude == pytest.approx(row["lat"], abs=1e-6)
        if exif:
            assert exif[ExifTags.Base.Artist] == row["owner"]
    assert (False, False) in seen
    assert (True, True) in seen


def test_an_interrupted_album_goes_on_and_ends_the_same(album: Path, tmp_path: Path) -> None:
    files = sorted(p.relative_to(album) for p in album.rglob("*.*"))
    kept = [f for f in files if f.suffix == ".jpg"]
    for file in kept[::2]:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_bytes((album / file).read_bytes())
    before = {file: (tmp_path / file).stat().st_mtime_ns for file in kept[::2]}
    calls: list[tuple[int, int]] = []
    write_album(
        tmp_path, TINY, partial(community_album, TINY), workers=1, progress=lambda *done: calls.append(done)
    )
    assert calls[0] == (len(kept[::2]) + 1, len(kept))
    assert {file: (tmp_path / file).stat().st_mtime_ns for file in before} == before
    assert sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*.*")) == files
    for file in files:
        assert (tmp_path / file).read_bytes() == (album / file).read_bytes(), file


def test_a_walk_advances_step_by_step_from_anchor_to_anchor() -> None:
    options = WalkOptions(
        town_size_m=(420.0, 180.0),
        flight=FLIGHT,
        start_m=-100.0,
        end_m=60.0,
        step_m=40.0,
        per_step=2,
        probes=1,
    )
    scene, photos = options.scene("home/0/000"), plan_walk(options)
    along = [(p.fact, float((scene.enu_from_town.T @ p.shot.cam_from_local.center)[0])) for p in photos]
    assert options.steps == 5
    walk = [(fact, x) for fact, x in along if fact.kind == "walk"]
    assert {fact.owner for fact, _ in walk} == {"bert", "carla", "jonas"}
    for fact, x in walk:
        start = -100.0 + 40.0 * fact.batch
        assert start - 16.1 <= x <= start + 40.1
    assert all(abs(x + 100.0) < 30.0 for fact, x in along if fact.kind == "survey")
    assert all(abs(x - 60.0) < 30.0 for fact, x in along if fact.kind == "survey_far")
    assert {fact.owner for fact, _ in along if fact.kind == "probe"} == {"probe"}


def test_traps_stand_where_they_should() -> None:
    options = PoisonOptions(
        town_size_m=(420.0, 200.0),
        flight=replace(FLIGHT, lines=3, per_line=6, width=1600, center_m=(-110.0, 0.0)),
        honest=4,
        late=2,
        canaries=2,
        per_poison=3,
        sights=3,
        width=320,
    )
    places, scene, photos = poison_places(options), options.scene("home/0/000"), plan_poison(options)
    kinds = {kind: [p for p in photos if p.fact.kind == kind] for kind in POISONS}
    assert all(len(found) == 3 for found in kinds.values())
    assert places.target[0] > places.mapped[2]

    def center(p: object) -> np.ndarray:  # type: ignore[type-arg]
        return scene.enu_from_town.T @ p.shot.cam_from_local.center  # type: ignore[attr-defined, no-any-return]

    assert all(center(p)[0] > places.mapped[2] for p in kinds["lookalike"] + kinds["mirror_block"])
    for p in kinds["liar"]:
        assert p.geotag is not None
        height = p.geotag.height_m or 0.0
        claimed = scene.frame.enu_from_geodetic((p.geotag.latitude_deg, p.geotag.longitude_deg, height))
        assert np.linalg.norm(claimed - p.shot.cam_from_local.center) > 140.0
    assert all(p.edits[0].kind == "mirrored" for p in kinds["mirrored"])
    assert all(p.scene.startswith("forged/") for p in kinds["forged"])
    assert not any(p.fact.home for p in kinds["liar_other"])
