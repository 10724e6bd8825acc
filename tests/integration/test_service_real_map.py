"""The commands on a real database and a real map with exact truth: serve, query, localise, hot reload."""

import io
import json
import re
import signal
import threading
import time
from importlib.metadata import EntryPoint

import cv2
import numpy as np
import pytest
from PIL import Image

from featuredb.cli.main import build_parser, run_command
from featuredb.errors import ServiceError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.utm import geodetic_from_utm
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import matrix_from_quaternion
from featuredb.store import Database
from featuredb.store.candidates.photos import list_candidates
from reloc.answered_view import AnsweredView
from reloc.client import CameraRequest, Client, PriorRequest
from reloc.service.options import ServeOptions
from reloc.service.serve import serve
from reloc.wire.query import LocaliseReply
from tests.support.contributions import load_image
from tests.support.events import watch_events
from tests.support.planar_map import (
    CAMERA,
    EASTING,
    EPSG,
    HEIGHT,
    NORTHING,
    field_texture,
    planar_map,
    render,
    view,
)
from tools.serve_process import ServeProcess

pytestmark = pytest.mark.slow

CAMERA_TEXT = "PINHOLE,640,480,600,600,320,240"
CAMERA_REQUEST = CameraRequest(model="PINHOLE", width=640, height=480, params=CAMERA.params)
HELD_OUT = {"a.png": view(4, -6, 40, 10, 33), "b.png": view(-7, 8, 50, 20, 200)}
# The map's points are exact, so what remains is half a pixel of keypoint noise at 40 to 50 m.
TOLERANCE_M, TOLERANCE_DEG = 0.05, 0.1


def png(gray) -> bytes:
    out = io.BytesIO()
    Image.fromarray(gray).save(out, "PNG")
    return out.getvalue()


@pytest.fixture(scope="module")
def field():
    return planar_map(1)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    texture = field_texture(1)
    for i, (name, pose) in enumerate(HELD_OUT.items()):
        (folder / name).write_bytes(png(render(texture, pose, seed=50 + i)))
    (folder / "elsewhere.png").write_bytes(png(render(field_texture(9), HELD_OUT["a.png"])))
    return folder


@pytest.fixture(scope="module")
def database(tmp_path_factory, field):
    path = tmp_path_factory.mktemp("store") / "Field maps"
    Database.create(path).commit_map(field)
    return path


def parse(*argv: str):
    entry = EntryPoint(name="reloc", value="reloc.cli.commands:register", group="featuredb.commands")
    return build_parser([entry]).parse_args([str(a) for a in argv])


def run(*argv: str) -> int:
    args = parse(*argv)
    return run_command(args.run, args)


@pytest.fixture(scope="module")
def server(database):
    process = ServeProcess(database)
    yield process
    assert process.stop() == 0


def center_error(reply: LocaliseReply, truth: Rigid3) -> float:
    """Metres."""
    frame = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
    found = (reply.utm.easting, reply.utm.northing, reply.utm.height)
    return float(np.linalg.norm(frame.utm_from_enu(truth.center, EPSG) - found))


def assert_pose(reply: LocaliseReply, truth: Rigid3, east_m: float = 0.0) -> None:
    """Against the truth by UTM and rotation, independently of the GeoPose."""
    frame = LocalFrame.from_utm(EASTING + east_m, NORTHING, HEIGHT, EPSG)
    utm = frame.utm_from_enu(truth.center, EPSG)
    found = (reply.utm.easting, reply.utm.northing, reply.utm.height)
    assert np.linalg.norm(utm - found) < TOLERANCE_M
    cam_from_grid = matrix_from_quaternion(reply.utm.cam_from_utm_xyzw)
    expected = truth.rotation @ frame.grid_from_enu(truth.center, EPSG).T
    angle = np.degrees(np.arccos(np.clip((np.trace(cam_from_grid @ expected.T) - 1) / 2, -1, 1)))
    assert angle < TOLERANCE_DEG


def test_query_command_prints_json_with_the_true_pose(server, photos, capsys):
    images = [str(photos / name) for name in HELD_OUT]
    assert run("query", *images, "--connect", server.endpoint, "--camera", CAMERA_TEXT, "--json") == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line.pop("image") for line in lines] == images
    for line, truth in zip(lines, HELD_OUT.values(), strict=True):
        reply = LocaliseReply.model_validate_json(json.dumps(line))
        assert reply.maps == ("field",)
        assert reply.lineage[0].method == "gcp"
        assert_pose(reply, truth)
        stages = [ms for name, ms in reply.timings_ms.items() if name != "total"]
        assert sum(stages) == pytest.approx(reply.timings_ms["total"], abs=0.01)


def test_localise_command_gives_the_same_answer_without_a_server(server, database, photos, capsys):
    image = str(photos / "a.png")
    run("query", image, "--connect", server.endpoint, "--camera", CAMERA_TEXT, "--json")
    over_the_wire = json.loads(capsys.readouterr().out)
    assert run("localise", str(database), image, "--camera", CAMERA_TEXT, "--json") == 0
    here = json.loads(capsys.readouterr().out)
    assert {**over_the_wire, "timings_ms": 0, "request_id": 0} == {**here, "timings_ms": 0, "request_id": 0}


def test_photos_of_one_camera_share_a_lens(server, database, tmp_path, capsys):
    """Asked one by one the flat field hardly tells their lens; together their tilts do."""
    texture = field_texture(1)
    views = {
        f"{i}.png": view(4 * i - 8, 6 - 3 * i, 40 + 3 * i, tilt, 70 * i)
        for i, tilt in enumerate((8, 25, 35, 20, 30))
    }
    for name, pose in views.items():
        (tmp_path / name).write_bytes(png(render(texture, pose)))
    images = [str(tmp_path / name) for name in views]
    off, claimed = {}, {}
    exact = ("--camera", CAMERA_TEXT)
    for words in (exact, (), ("--shared-lens",)):
        assert run("localise", str(database), *images, "--json", *words) == 0
        said = capsys.readouterr()
        replies = [json.loads(line) for line in said.out.splitlines()]
        for reply in replies:
            reply.pop("image")
        answers = [LocaliseReply.model_validate_json(json.dumps(reply)) for reply in replies]
        off[words] = [center_error(a, truth) for a, truth in zip(answers, views.values(), strict=True)]
        claimed[words] = [np.hypot(a.accuracy.horizontal_68_m, a.accuracy.vertical_68_m) for a in answers]
        assert (np.array(off[words]) < 3 * np.array(claimed[words])).all()
    assert np.mean(off["--shared-lens",]) < np.mean(off[()])
    # An estimated lens is not taken for a known one.
    assert 2 * np.max(claimed[exact]) < np.max(claimed["--shared-lens",]) < np.median(claimed[()])
    assert "lens of 5 of 5 photos: --camera=OPENCV,640,480," in said.err
    assert {r["camera"]["source"] for r in replies} == {"request"}
    # What is printed is taken, and gives the same answer over the wire.
    words = re.search(r"(--camera=\S+) (--camera-sigmas=\S+)", said.err).groups()
    assert run("query", images[0], "--connect", server.endpoint, "--json", *words) == 0
    again = json.loads(capsys.readouterr().out)
    for key, a_millimetre in (("lat", 1e-8), ("lon", 1e-8), ("h", 1e-3)):
        assert again["position"][key] == pytest.approx(replies[0]["position"][key], rel=0.0, abs=a_millimetre)
    assert run("localise", str(database), *images[:2], "--json", "--shared-lens") == 0
    assert "no lens that three photos or more agree on" in capsys.readouterr().err


def test_a_shared_lens_and_a_given_one_exclude_each_other(database, photos, capsys):
    image = str(photos / "a.png")
    assert run("localise", str(database), image, "--shared-lens", "--camera", CAMERA_TEXT) == 2
    assert "--shared-lens: expected no --camera" in capsys.readouterr().err
    sigmas = "--camera-sigmas=1,1,1,1"
    assert run("localise", str(database), image, "--camera", CAMERA_TEXT, sigmas) == 2
    assert "OPENCV" in capsys.readouterr().err


def test_people_read_utm_degrees_accuracy_and_what_to_try(server, photos, capsys):
    code = run(
        "query",
        str(photos / "a.png"),
        str(photos / "elsewhere.png"),
        "--connect",
        server.endpoint,
        "--camera",
        CAMERA_TEXT,
    )
    out = capsys.readouterr().out
    assert code == 1
    frame = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
    easting, northing, _ = frame.utm_from_enu(HELD_OUT["a.png"].center, EPSG)
    assert float(re.search(rf"EPSG:{EPSG}  E (\S+)", out)[1]) == pytest.approx(easting, abs=TOLERANCE_M)
    lat, lon, _ = geodetic_from_utm((easting, northing, HEIGHT), EPSG)
    said = re.search(r"WGS84 +(\S+), (\S+) +h", out)
    assert (float(said[1]), float(said[2])) == pytest.approx((lat, lon), abs=1e-6)  # 0.1 m
    assert "68 %" in out
    assert "not localised in Field-maps: TOO_FEW_" in out
    assert "looks     heading " in out
    assert "95 %" in out
    assert "try:" in out


def test_overlay_projects_the_inliers_onto_their_keypoints(server, database, photos, tmp_path, capsys):
    targets = tmp_path / "query.png", tmp_path / "here.png"
    common = [str(photos / "a.png"), "--camera", CAMERA_TEXT, "--json", "--overlay"]
    assert run("query", *common, str(targets[0]), "--connect", server.endpoint) == 0
    reply_json = json.loads(capsys.readouterr().out)
    reply_json.pop("image")
    reply = LocaliseReply.model_validate_json(json.dumps(reply_json))
    assert run("localise", str(database), *common, str(targets[1])) == 0
    keypoints = np.array(reply.inlier_points.pixels)
    projected = AnsweredView.of_reply(reply).project_utm(np.array(reply.inlier_points.utm))
    residual = np.linalg.norm(keypoints - projected, axis=1)
    assert len(residual) == reply.inliers
    # The drawing's own projection agrees with the pose estimator's residual.
    assert np.sqrt((residual**2).mean()) == pytest.approx(reply.residual_rms_px, rel=0.5)
    assert residual.max() < 4.0
    photo = cv2.imread(str(photos / "a.png"))
    query, here = (cv2.imread(str(t)) for t in targets)
    assert query.shape == here.shape == photo.shape
    assert query[-44:-30].mean() < 0.6 * photo[-44:-30].mean(), "a legend stands there"
    green = (query[:, :, 1].astype(int) - query[:, :, 0] > 60).sum()
    blue = [(p[:, :, 0].astype(int) - p[:, :, 2] > 60).sum() for p in (query, here)]
    assert green > 1000
    assert blue[0] == 0, "a client knows no other points"
    assert blue[1] > 100, "the database does"


def test_several_overlays_get_names_of_their_own(database, photos, tmp_path, capsys):
    blank = tmp_path / "blank.jpg"
    Image.new("RGB", (640, 480), "grey").save(blank)
    images = [str(photos / name) for name in HELD_OUT] + [str(blank)]
    run("localise", str(database), *images, "--camera", CAMERA_TEXT, "--overlay", str(tmp_path / "o.png"))
    assert sorted(p.name for p in tmp_path.glob("*.png")) == ["o-a.png", "o-b.png"]
    assert f"{blank}: no overlay, as it was not localised" in capsys.readouterr().err


def test_priors_select_and_contradict(server, photos, capsys):
    lat, lon, _ = geodetic_from_utm((EASTING, NORTHING, HEIGHT), EPSG)
    image = (photos / "a.png").read_bytes()
    with Client(server.endpoint) as client:
        assert client.database == "Field-maps"
        near = client.localise(image, PriorRequest(lat=lat, lon=lon, sigma_m=20), CAMERA_REQUEST)
        assert_pose(near, HELD_OUT["a.png"])
        far = client.localise(image, PriorRequest(lat=lat + 1, lon=lon, sigma_m=20), CAMERA_REQUEST)
        assert (far.status, far.reason) == ("not_localised", "NO_COVERAGE")
        pole = client.localise(image, PriorRequest(lat=90, lon=0, sigma_m=20), CAMERA_REQUEST)
        assert (pole.status, pole.reason) == ("not_localised", "NO_COVERAGE")
        with pytest.raises(ServiceError, match="nowhere") as caught:
            client.localise(image, camera=CAMERA_REQUEST, maps=("nowhere",))
        assert caught.value.code == "BAD_REQUEST"


def test_a_southern_prior_is_understood():
    from reloc.cli.query_arguments import parse_prior

    args = parse("query", "x.jpg", "--prior=-33.86,151.21,25")
    assert parse_prior(args.prior) == PriorRequest(lat=-33.86, lon=151.21, sigma_m=25.0)


def test_bad_arguments_are_explained(photos, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(Client.__init__.__kwdefaults__, "connect_timeout_s", 0.5)
    image = str(photos / "a.png")
    assert run("query", image, "--prior", "91,0,5") == 2
    assert "LAT,LON,SIGMA_M" in capsys.readouterr().err
    assert run("query", image, "--camera", "PINHOLE,640") == 2
    assert "MODEL,WIDTH,HEIGHT" in capsys.readouterr().err
    assert run("query", image, "--connect", "tcp/127.0.0.1:9") == 2
    assert "nobody answers at tcp/127.0.0.1:9" in capsys.readouterr().err
    assert run("serve", str(tmp_path / "none")) == 2
    assert "create the database with `featuredb init`" in capsys.readouterr().err


def test_an_unreadable_image_does_not_stop_the_others(server, photos, tmp_path, capsys):
    broken = tmp_path / "broken.jpg"
    broken.write_bytes(b"\xff\xd8\xff\xe0 not much")
    images = [str(broken), str(tmp_path / "missing.jpg"), str(photos / "a.png")]
    assert run("query", *images, "--connect", server.endpoint, "--camera", CAMERA_TEXT) == 2
    captured = capsys.readouterr()
    assert "BAD_IMAGE" in captured.err
    assert "missing.jpg: No such file" in captured.err
    assert "a.png: localised" in captured.out


def test_a_map_of_another_extractor_is_refused_not_answered_wrongly(tmp_path, photos):
    database = Database.create(tmp_path / "other")
    database.commit_map(planar_map(1, fingerprint="another-extractor"))
    process = ServeProcess(tmp_path / "other")
    with Client(process.endpoint) as client, pytest.raises(ServiceError, match="another-extractor") as caught:
        client.localise((photos / "a.png").read_bytes(), camera=CAMERA_REQUEST)
    assert caught.value.code == "INCOMPATIBLE_EXTRACTOR"
    assert process.stop() == 0


def test_hot_reload_commit_retire_and_a_clean_end(tmp_path, field, photos):
    """A map committed while the server runs answers within seconds, a retired one no more."""
    database = Database.create(tmp_path / "growing")
    process = ServeProcess(tmp_path / "growing", "--name", "growing")
    image = (photos / "a.png").read_bytes()
    with Client(process.endpoint) as client, watch_events(client) as events:

        def wait_for_reload() -> list[str]:
            seen = []
            while (event := events.next(timeout_s=20)) is not None:
                seen.append(event.type)
                if event.type == "reloaded":
                    return seen
            raise AssertionError(f"no reload within 20 s, only {seen}; log: {process.errors}")

        before = client.localise(image, camera=CAMERA_REQUEST)
        assert (before.status, before.reason) == ("not_localised", "NO_COVERAGE")
        assert client.maps().maps == ()
        database.commit_map(field)
        assert wait_for_reload() == ["map_committed", "reloaded"]
        after = client.localise(image, camera=CAMERA_REQUEST)
        assert_pose(after, HELD_OUT["a.png"])
        assert after.snapshot == database.poll_version() > before.snapshot
        (info,) = client.maps().maps
        assert (info.map_id, info.points, info.images) == ("field", len(field.points), 9)
        assert info.tiles
        south_west = geodetic_from_utm(field.points.utm.min(axis=0), EPSG)
        assert (info.bounds.south, info.bounds.west) == pytest.approx(south_west[:2], abs=1e-4)
        database.retire("field", "test")
        assert wait_for_reload() == ["map_retired", "reloaded"]
        assert client.localise(image, camera=CAMERA_REQUEST).reason == "NO_COVERAGE"
    assert process.stop(signal.SIGTERM) == 0
    log = process.log()
    assert [line["event"] for line in log if line.get("event") in ("loading", "serving", "stopped")] == [
        "loading",
        "serving",
        "stopped",
    ]
    answered = [line for line in log if line.get("event") == "answered"]
    assert [line["status"] for line in answered] == ["not_localised", "localised", "not_localised"]
    assert len({line["request_id"] for line in answered}) == 3


def test_a_query_is_contributed_and_the_inbox_lists_it(server, database, photos, capsys):
    query = ["query", str(photos / "a.png"), "--connect", server.endpoint, "--camera", CAMERA_TEXT]
    assert run(*query, "--contribute", "--credit", "A. Person", "--licence", "CC0-1.0") == 0
    given = re.search(r"^  given     candidate ([0-9a-f]{32})$", capsys.readouterr().out, flags=re.MULTILINE)
    end = time.monotonic() + 30.0
    while not (found := list_candidates(Database.open(database))):
        assert time.monotonic() < end
        time.sleep(0.05)
    assert [c.candidate_id for c in found] == [given[1]]
    assert found[0].answer["maps"] == ["field"]
    assert load_image(Database.open(database), given[1]) == (photos / "a.png").read_bytes()
    assert run(*query, "--contribute", "--credit", "A. Person") == 2
    assert "expected --credit and --licence" in capsys.readouterr().err


def test_a_stop_signal_that_another_thread_receives_ends_the_server(database):
    """The kernel may give it to any thread; a wait of the main thread does not end by that."""
    before = signal.getsignal(signal.SIGTERM)
    sent: list[threading.Thread] = []

    def on_ready(server):
        def send():
            time.sleep(0.5)  # the main thread waits by then
            signal.pthread_kill(threading.get_ident(), signal.SIGTERM)
            time.sleep(20.0)

        sent.append(threading.Thread(target=send, daemon=True))
        sent[0].start()

    serve(Database.open(database), ServeOptions(listen=("tcp/127.0.0.1:0",)), on_ready=on_ready)
    assert sent[0].is_alive()  # ended by the signal, not by the thread's end
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_server_told_to_take_no_contributions(database, photos, capsys):
    process = ServeProcess(database, "--contributions", "off")
    query = ["query", str(photos / "a.png"), "--connect", process.endpoint, "--camera", CAMERA_TEXT]
    assert run(*query, "--contribute", "--credit", "A. Person", "--licence", "CC0-1.0") == 2
    assert "UNSUPPORTED" in capsys.readouterr().err
    assert process.stop() == 0
