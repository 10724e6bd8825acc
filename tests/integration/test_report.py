"""The ingest report: figures against an independent count, schema, a page without network or injection."""

import json
import re
from dataclasses import replace
from datetime import UTC, datetime
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import numpy as np
import pytest
from PIL import Image

from featuredb.geometry.sim3 import Sim3
from featuredb.maps.place_bounds import PlaceBounds
from ingest.api.ingesting import summary
from ingest.plot_parts import PlanView, plan_png, residual_exaggeration
from ingest.report.outcomes import _gps_used
from ingest.report.page import write_report
from ingest.report.values import (
    CameraOutcome,
    IngestReport,
    MapOutcome,
    PhotoOutcome,
    StageTiming,
    report_json,
)

SCHEMA = json.loads(
    (Path(__file__).resolve().parents[2] / "schemas" / "ingest" / "report.json").read_text(encoding="utf-8")
)
HOSTILE = '<script src="http://evil.example/x.js">&"\'.jpg'


class _Links(HTMLParser):
    """Tags, addresses and texts of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.links: list[str] = []
        self.texts: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "action")]

    def handle_data(self, data: str) -> None:
        self.texts.add(data)


def plan(k: int = 5, n: int = 2000, seed: int = 1) -> PlanView:
    """A flight of k photos across a tile border."""
    rng = np.random.default_rng(seed)
    origin = np.array([512.0 * 1126, 512.0 * 10133, 150.0])
    cameras = origin + np.column_stack([np.linspace(-60, 60, k), np.linspace(-20, 30, k), np.full(k, 40.0)])
    residuals = rng.normal(0, 0.5, (k, 3))
    residuals[0] = np.nan
    residuals[1, 2] = np.nan
    residuals[2, :2] += 25.0
    return PlanView(
        points=origin + rng.uniform(-80, 80, (n, 3)) * (1, 1, 0.05),
        cameras=cameras,
        places=cameras,
        residuals=residuals,
        names=tuple(f"{i}.jpg" for i in range(k)),
        used=np.arange(k) != 2,
        title="EPSG:32615",
        what="GPS",
    )


def report(**changes: Any) -> IngestReport:
    camera = CameraOutcome(
        name="maker|model",
        model="SIMPLE_RADIAL",
        width=400,
        height=300,
        photos=5,
        focal_before_px=300.0,
        focal_after_px=303.0,
    )
    placed = MapOutcome(
        map_id="m0",
        name="flight",
        status="committed",
        photos=5,
        points=2000,
        observations=5000,
        descriptors=3000,
        epsg=32615,
        height_datum="unknown",
        scale=8.5,
        residual_rms_m=0.4,
        gates={"rms": np.float64(0.4), "bad": float("nan"), "inliers": np.array([True, False])},
        cameras=(camera,),
        errors_px=np.linspace(0, 2, 2001, dtype=np.float32),
        track_lengths=np.array([2] * 10 + [3] * 5 + [7] * 3 + [60], dtype=np.int32),
        plan=plan(),
    )
    refused = MapOutcome(
        map_id="", name="rest", status="refused", reason_code="TOO_FEW", reason="2 photos have GPS", photos=2
    )
    photos = (
        PhotoOutcome(
            name="a.jpg",
            status="registered",
            map_id="m0",
            features=100,
            matches=50,
            observations=20,
            reprojection_px=0.5,
            has_gps=True,
            gps_residual_m=(0.3, 0.4, float("nan")),
            gps_used=True,
            capture_time=datetime(2024, 1, 2, 3, 4, 5),
        ),
        PhotoOutcome(name="b.jpg", status="not_registered", reason_code="NO_OVERLAP", reason="alone"),
        PhotoOutcome(
            name=HOSTILE, status="skipped", reason_code="broken", reason=HOSTILE, warnings=(HOSTILE,)
        ),
    )
    base = IngestReport(
        job_id="j" * 32,
        database="db",
        folder="/photos/flight",
        started=datetime(2024, 1, 2, tzinfo=UTC),
        options={"path": Path("/x"), "n": 1},
        versions={"featuredb": "0.1.0"},
        pairs=10,
        verified_pairs=7,
        stages=(
            StageTiming(name="scan", seconds=1.5),
            StageTiming(name="match", seconds=0.0, reused=3, total=7),
        ),
        photos=photos,
        maps=(placed, refused),
        warnings=(HOSTILE,),
    )
    return replace(base, **changes)


def test_json_follows_its_schema_and_counts(tmp_path: Path) -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    write_report(tmp_path, report())
    document = json.loads(
        (tmp_path / "report.json").read_text(encoding="utf-8"), parse_constant=pytest.fail
    )  # no NaN
    jsonschema.validate(document, SCHEMA)
    assert document["files"] == {
        "all": 3, "registered": 1, "unplaced": 0, "not_registered": 1, "skipped": 1
    }  # fmt: skip
    assert document["seconds"] == 1.5
    first = document["maps"][0]
    assert first["reprojection_px"] == pytest.approx({"p50": 1.0, "p90": 1.8, "p99": 1.98}, abs=1e-3)
    assert {t["from"]: t["points"] for t in first["track_lengths"] if t["points"]} == {
        2: 10,
        3: 5,
        6: 3,
        50: 1,
    }
    assert first["gates"] == {"rms": 0.4, "bad": None, "inliers": [True, False]}
    assert document["photos"][0]["gps_residual_m"] == [0.3, 0.4, None]


@pytest.mark.parametrize(
    "photo",
    [
        PhotoOutcome(name="x", status="skipped"),
        PhotoOutcome(name="x", status="registered"),
        PhotoOutcome(name="x", status="not_registered", reason_code="A", reason="b", map_id="m0"),
    ],
)
def test_the_schema_wants_a_reason_or_a_map(photo: PhotoOutcome) -> None:
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(report_json(report(photos=(photo,))), SCHEMA)


def test_page_is_self_contained_and_escaped(tmp_path: Path) -> None:
    write_report(tmp_path, report())
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 1
    parser = _Links()
    parser.feed(page)
    assert "script" not in parser.tags
    assert all(link.startswith("data:image/png;base64,") for link in parser.links)
    assert len(parser.links) == 1
    assert HOSTILE in parser.texts  # seen as it is called, and as text only
    without_pictures = re.sub(r"data:image/png;base64,[A-Za-z0-9+/=]+", "", page)
    for word in (
        "a.jpg",
        "b.jpg",
        "alone",
        "TOO_FEW",
        "2 photos have GPS",
        "0.50",
        "+1.0 %",
        "3 of 7",
        "median 1.00 px",
    ):
        assert word in without_pictures
    assert {path.name for path in tmp_path.iterdir()} == {"report.html", "report.json"}


def test_a_report_of_nothing_can_be_written(tmp_path: Path) -> None:
    write_report(tmp_path, report(maps=(), photos=(), stages=(), warnings=()))
    document = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    jsonschema.validate(document, SCHEMA)


def test_terminal_and_page_say_what_a_place_is_worth(tmp_path: Path) -> None:
    bounds = PlaceBounds(horizontal_m=9.19, vertical_m=18.7, tilt_deg=4.43, heading_deg=2.84)
    angles = {"told": False, "tilt_off_deg": 3.91, "tilt_contradicts": False}
    gates = {"turn_sigma_deg": 1.92, "noise_m": [1.7, 3.3], "angles": angles, "options": {"wrong": 0.001}}
    of_gps = replace(report().maps[0], place=bounds, gates=gates)
    text = summary(report(maps=(of_gps,)))
    write_report(tmp_path, report(maps=(of_gps,)))
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    for words in ("9.19 m horizontally", "tilted by 4.4 degrees", "3.9 degrees off level", "a scan"):
        assert words in text
        assert words in page
    rows = re.findall(r"<tr><td[^>]*>(\w+)</td><td[^>]*>([^<]+)</td><td[^>]*>[^<]{20,}</td></tr>", page)
    assert rows == [
        ("noise_m", "1.7, 3.3"),
        ("turn_sigma_deg", "1.92"),
        ("told", "no"),
        ("tilt_off_deg", "3.91"),
        ("tilt_contradicts", "no"),
    ]
    jsonschema.validate(report_json(report(maps=(of_gps,))), SCHEMA)


@pytest.mark.parametrize("k", [1, 2, 60])
def test_pictures_of_few_and_many_photos(k: int) -> None:
    view = plan(max(k, 3))
    view = replace(
        view,
        cameras=view.cameras[:k],
        places=view.places[:k],
        residuals=np.full((k, 3), np.nan) if k == 2 else view.residuals[:k],
        names=view.names[:k],
        used=view.used[:k],
        points=view.points[:0] if k == 1 else view.points,
    )
    assert plan_png(view)[:8] == b"\x89PNG\r\n\x1a\n"


def test_plan_shows_cameras_where_they_are(tmp_path: Path) -> None:
    """Without points and GPS the picture of one camera has ink, and differs when there is a second one."""
    view = plan(3)
    nowhere = np.full((3, 3), np.nan)
    one, two = (
        np.asarray(
            Image.open(_file(tmp_path, plan_png(replace(view, residuals=nowhere, names=names)))).convert("L")
        )
        for names in (("a", "b", "c"), ("", "", ""))
    )
    assert one.shape == two.shape
    assert 0 < np.count_nonzero(one != two) < 0.02 * one.size  # the names only


def test_changed_focal_lengths_are_warned_about() -> None:
    outcome = report().maps[0]
    assert outcome.warnings == ()
    changed = replace(outcome, cameras=(replace(outcome.cameras[0], focal_after_px=330.0),))
    assert "330 px, EXIF says 300" in changed.warnings[0]
    unknown = replace(outcome, cameras=(replace(outcome.cameras[0], focal_before_px=None),))
    assert unknown.warnings == ()


def test_exaggeration() -> None:
    # 3 % of 100 m over a median of 0.4 m is 7.5; 15 % over the longest of 1 m is 15.
    residuals = np.array([[0.4, 0.0], [0.0, 0.4], [1.0, 0.0], [np.nan, np.nan], [0.0, -0.3]])
    assert residual_exaggeration(residuals, 100.0) == 5
    assert residual_exaggeration(residuals * 100, 100.0) == 1
    assert residual_exaggeration(np.full((2, 2), np.nan), 100.0) == 1


def _file(folder: Path, data: bytes) -> Path:
    path = folder / "picture.png"
    path.write_bytes(data)
    return path


def test_pictures_that_are_sheared_are_warned_of() -> None:
    sheared = MapOutcome(map_id="m1", name="n", status="committed", picture_shear=2e-4)
    assert any("rolling shutter" in text and "0.020%" in text for text in sheared.warnings)
    assert not MapOutcome(map_id="m2", name="n", status="committed", picture_shear=5e-5).warnings


def test_positions_that_control_points_outdo_contradict_nobody() -> None:
    placed = SimpleNamespace(local_from_sfm=Sim3.identity(), inliers=[True, False])
    by_gps = SimpleNamespace(control=None, placement=placed, with_gps=(0, 2))
    assert _gps_used(by_gps) == {0: True, 2: False}  # type: ignore[arg-type]
    by_control = SimpleNamespace(control=object(), placement=placed, with_gps=(0, 2))
    assert _gps_used(by_control) == {}  # type: ignore[arg-type]
    too_few = SimpleNamespace(local_from_sfm=None, inliers=[False])
    assert _gps_used(SimpleNamespace(control=None, placement=too_few, with_gps=(0,))) == {}  # type: ignore[arg-type]
