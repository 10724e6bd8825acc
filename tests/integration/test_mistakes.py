"""What people mistype ends at once: one line says what to do, by options that exist, and nothing is made.

What a library writes past Python is seen as well: it is all that comes to the file descriptors.
"""

import argparse
import ast
import logging
import re
import socket
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest

from featuredb.cli.main import COMMAND_GROUP, build_parser, main
from featuredb.store import Database
from reloc.client import Client
from tests.conftest import REPOSITORY
from tests.support import planar_map as field
from tests.support.films import film

_NO_CA = '{mode: "client", transport: {link: {tls: {root_ca_certificate: "gone/ca.pem"}}}}'

# Command, and what its line has to say. {port} is one at which nobody listens.
MISTAKES = {
    "a camera model that does not exist": (
        "ingest photos new.db photos --camera-model FOO",
        r"expected one of SIMPLE_PINHOLE, .*OPENCV.*, found 'FOO'",
    ),
    "a path that is mistyped": (
        "ingest photos nowhere/new.db photos",
        r"there is no folder .*/nowhere to make a database in; check the path",
    ),
    "a database that would lie in a folder of photos": (
        "ingest photos photos photos",
        r"photos is a folder of other things, and no database; name one that is free",
    ),
    "a folder without photos": (
        "ingest photos new.db texts",
        r"texts: expected photos \(JPEG, .*\).*, found none among 1 files; check the path",
    ),
    "a scan that is not there": (
        "lidar add new.db missing.laz",
        r"missing.laz: expected a LAS, LAZ or COPC file, found none; check the path",
    ),
    "a folder in place of its scans": (
        "lidar add new.db .",
        r"\.: expected a LAS, LAZ or COPC file, found a folder; name those in it, such as scan\.las",
    ),
    "a folder without scans": (
        "lidar add new.db texts",
        r"texts: expected a LAS, LAZ or COPC file, found a folder; it has no \.las, \.laz or \.tif",
    ),
    "a scan that is cut off": (
        "lidar add new.db cut/scan.laz --crs EPSG:32632",
        r"cut/scan\.laz: expected a readable LAS, LAZ or COPC file, found one that is truncated or broken",
    ),
    "a scan without a coordinate system": (
        "lidar add new.db scan.las",
        r"expected a coordinate system in the file, found none; state the coordinate system by --crs",
    ),
    "an EPSG code that does not exist": (
        "lidar add new.db scan.las --crs EPSG:99999",
        r"--crs: expected an EPSG code such as .*, found 'EPSG:99999'",
    ),
    "the EPSG code of another country": (
        "lidar add new.db scan.las --crs EPSG:2056",
        r"outside the area that the CRS is for .*; state the coordinate system by --crs",
    ),
    "a database that is none": (
        "localise photos photos/a.jpg",
        r"no featuredb table at .*photos/maps; check the path, or create the database with `featuredb init`",
    ),
    "a database of a newer format": (
        "localise newer.db photos/a.jpg",
        r"has featuredb format 999, expected \d+ or older; use a newer featuredb",
    ),
    "a photo that is not there": (
        "localise field.db missing.jpg",
        r"missing.jpg: expected a photo, found no such file; check the path",
    ),
    "a server that is not there": (
        "query photos/a.jpg --connect tcp/127.0.0.1:{port}",
        r"nobody answers at tcp/127.0.0.1:\d+; is `featuredb serve` running, and is this its --listen",
    ),
    "a configuration that is not there": (
        "query photos/a.jpg --config missing.json5",
        r"--config: expected a Zenoh configuration .* in missing.json5, found: No such file .* keys",
    ),
    "a configuration that is cut off": (
        "live film.mp4 --config cut.json5",
        r"--config: .* in cut.json5, found: at 1:7 expected array",
    ),
    "a certificate that is not there": (
        "query photos/a.jpg --config tls.json5",
        r"--config: tls.json5: tls/root_ca_certificate: expected a file .* none at gone/ca.pem",
    ),
    "a gateway by an empty configuration": (
        "gateway --port 0 --config empty.json5",
        r"--config: .* in empty.json5, found: Empty config file; ",
    ),
    "a configuration that is a picture": (
        "query photos/a.jpg --config photos/a.jpg",
        r"--config: .* in photos/a.jpg, found: stream did not contain valid UTF-8",
    ),
    "an output that exists": (
        "export field.db texts --format colmap",
        r"texts: expected a name that is free, or an empty folder; nothing is overwritten",
    ),
    "a drawing over the photo": (
        "localise field.db photos/a.jpg --overlay photos/../photos/a.jpg",
        r"--overlay: expected another file than photos/a.jpg, which is read",
    ),
    "a server's drawing over a photo": (
        "query overlay-a.png photos/a.jpg --overlay overlay.png",
        r"--overlay: expected another file than overlay-a.png",
    ),
    "a film over the film": (
        "track field.db film.mp4 --out track.csv --overlay link.mp4",
        r"--overlay: expected another file than film.mp4, which is read, found link.mp4",
    ),
    "a track over the film": (
        "track field.db film.mp4 --out link.csv",
        r"--out: expected another file than film.mp4, which is read, found link.csv",
    ),
    "a track over the first pose": (
        "track field.db film.mp4 --pose pose.json --out pose.json",
        r"--out: expected another file than pose.json, which is read",
    ),
    "a track in place of a folder": (
        "track field.db film.mp4 --out folder.csv",
        r"--out: expected a file in a folder that can be written, found the folder folder.csv",
    ),
    "frames without times": (
        "track field.db photos --out track.csv",
        r"expected the times of its 1 pictures, found none; .* or give their rate by --fps",
    ),
    "an end before the start": (
        "track field.db film.mp4 --start 5 --end 2 --out track.csv",
        r"expected a start before the end, in seconds, found start 5\.0, end 2\.0",
    ),
    "a start past the end of a film that is tracked": (
        "track field.db film.mp4 --start 50 --out track.csv",
        r"film\.mp4: no frame between the start and the end .*; the film is 1\.2 s long",
    ),
    "a start past the end of a film that is ingested": (
        "ingest video new.db film.mp4 --start 50 --quiet",
        r"film\.mp4: no frame between the start and the end .*; the film is 1\.2 s long",
    ),
    "a film that is a picture": (
        "ingest video new.db film.gif --quiet",
        r"featuredb: film\.gif: expected mp4, mov",
    ),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A photo that cannot be decoded (who reads it says so), a scan, a text, and two databases."""
    here = tmp_path_factory.mktemp("mistakes")
    (here / "photos").mkdir()
    (here / "photos" / "a.jpg").write_bytes(b"\xff\xd8\xff\xe0 not much")
    (here / "texts").mkdir()
    (here / "texts" / "a.txt").write_text("no photo")
    (here / "film.gif").write_bytes(b"GIF89a and so on")
    film(here, "mp4")
    (here / "overlay-a.png").write_text("no photo")
    for name, text in (
        ("pose.json", ""),
        ("empty.json5", ""),
        ("cut.json5", "{mode:"),
        ("tls.json5", _NO_CA),
    ):
        (here / name).write_text(text)
    for name in ("link.mp4", "link.csv"):
        (here / name).symlink_to("film.mp4")
    (here / "folder.csv").mkdir()
    scan = laspy.LasData(laspy.LasHeader(point_format=1, version="1.2"))
    place = np.array([456_800.0, 5_429_300.0, 100.0]) + np.random.default_rng(0).uniform(0, 50, (100, 3))
    scan.x, scan.y, scan.z = place.T
    scan.write(str(here / "scan.las"))
    (here / "cut").mkdir()
    scan.write(str(here / "cut" / "scan.laz"))
    (here / "cut" / "scan.laz").write_bytes((here / "cut" / "scan.laz").read_bytes()[:-400])
    Database.create(here / "field.db").commit_map(field.planar_map())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("featuredb.store.durable.making.FORMAT_VERSION", 999)
        patch.setattr("featuredb.store.durable.making.READABLE_FORMATS", (999,))
        Database.create(here / "newer.db")
    return here


def contents(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_ends_in_one_line_that_says_what_to_do(
    folder: Path, mistake: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    command, said = MISTAKES[mistake]
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        words = command.format(port=nobody.getsockname()[1]).split()
    before = contents(folder)
    monkeypatch.chdir(folder)
    monkeypatch.setitem(Client.__init__.__kwdefaults__, "connect_timeout_s", 0.5)
    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # the command logs as it does in its own process
    capfd.readouterr()
    code = main(words)
    done = capfd.readouterr()
    assert (code, done.out) == (2, ""), done
    (line,) = done.err.splitlines()
    assert line.startswith("featuredb: ")
    assert re.search(said, line), line
    assert contents(folder) == before


@pytest.mark.parametrize("mistake", ["frames without times", "the EPSG code of another country"])
def test_a_process_of_its_own_writes_no_more_than_the_line(folder: Path, mistake: str) -> None:
    """Libraries may write while they are first imported; these two import most of them."""
    command, said = MISTAKES[mistake]
    done = subprocess.run(
        [sys.executable, "-m", "featuredb.cli", *command.split()],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, ""), done
    (line,) = done.stderr.splitlines()
    assert line.startswith("featuredb: ")
    assert re.search(said, line), line


def options_of(parser: argparse.ArgumentParser) -> set[str]:
    """Of all its subcommands."""
    found = set(parser._option_string_actions)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found.update(*(options_of(sub) for sub in action.choices.values()))
    return found


def test_every_option_that_a_text_names_exists() -> None:
    """Also those of help and of reports; CSS has names of that form behind brackets and semicolons."""
    known = options_of(build_parser(entry_points(group=COMMAND_GROUP)))
    of_others = {"--check", "--file"}  # sha256sum, projsync
    named = [
        (module.relative_to(REPOSITORY).as_posix(), option)
        for package in ("featuredb", "ingest", "reloc")
        for module in sorted((REPOSITORY / package).rglob("*.py"))
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        for option in re.findall(r"(?<![\w({;-])--[a-z][a-z-]*", node.value)
    ]
    assert len(named) > 300
    assert [(module, option) for module, option in named if option not in known | of_others] == []


def test_frames_with_a_rate_are_tracked(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    texture = field.field_texture(1)
    for k in range(3):
        frame = field.render(texture, field.view(0.5 * k, -6.0, 40.0, 8.0, 33.0), seed=k)
        cv2.imwrite(str(tmp_path / f"{k}.png"), frame)
    out = tmp_path / "track.csv"
    assert main(["track", str(folder / "field.db"), str(tmp_path), "--fps", "2", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "3 frames" in said
    assert "from 0.00 s to 1.00 s" in said
