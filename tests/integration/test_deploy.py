"""The files of `deploy/` go with the program: what the image takes in, and how the keys are made."""

import json
import re
import tomllib
from pathlib import Path

import pytest

from featuredb.cli.main import main

_ROOT = Path(__file__).parents[2]
_COMPOSE = (_ROOT / "deploy/compose.yaml").read_text()


def test_the_image_takes_in_the_packages_and_no_secrets() -> None:
    words = re.findall(r"^COPY (.+)$", (_ROOT / "deploy/Containerfile").read_text(), re.MULTILINE)
    copied = {source for line in words for source in line.split()[:-1]}
    wheel = tomllib.loads((_ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"][
        "wheel"
    ]
    assert copied == {"pyproject.toml", "README.md", "LICENSE", *wheel["packages"]}


def test_a_worker_that_grows_asks_the_scans() -> None:
    (extras,) = re.findall(r"/src\[([a-z,]+)\]", (_ROOT / "deploy/Containerfile").read_text())
    assert set(extras.split(",")) == {"heic", "http", "lidar"}


def test_keys_are_for_clients_outside_and_inside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    head = _COMPOSE[: _COMPOSE.index("x-featuredb:")].replace("HOST", "maps.example.org")
    commands = re.findall(r"`featuredb (keys [^`]+)`", head)
    assert len(commands) == 2
    for command in commands:
        assert main(command.split()) == 0
    client = json.loads((tmp_path / "keys/clients/web.json5").read_text().partition("\n")[2])
    assert client["connect"]["endpoints"] == ["tls/maps.example.org:7447", "tls/router:7447"]
