"""The client in TypeScript, run by the Node that Playwright brings, against a real gateway."""

import json
import re
import subprocess
from pathlib import Path

import playwright
import pytest

from reloc.localise.result import LocaliseRequest
from reloc.wire.query import LocaliseReply
from tests.conftest import REPOSITORY
from tests.support.gateway import running_gateway
from tests.support.service import EASTING, ScriptedLocaliser, photo, running_server

CLIENT = REPOSITORY / "examples" / "localise.ts"
NODE = Path(playwright.__file__).parent / "driver" / "node"


def _run(*arguments: object) -> "subprocess.CompletedProcess[str]":
    command = [NODE, CLIENT, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)


def test_it_asks_and_tells_answers_and_refusals(tmp_path: Path) -> None:
    good, broken = tmp_path / "photo.jpg", tmp_path / "broken.jpg"
    good.write_bytes(photo())
    broken.write_bytes(b"no picture")
    localiser = ScriptedLocaliser(1)
    with running_server(localiser) as server, running_gateway(server.endpoints[0]) as gateway:
        done = _run(f"{gateway.url}/", good, 49.01, 8.4, 25)
        refused = _run(gateway.url, broken)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert answer["status"] == "localised"
    assert answer["utm"]["easting"] == pytest.approx(EASTING + 30, abs=0.5)
    request: LocaliseRequest = localiser.requests[0]
    assert request.prior is not None
    assert (request.prior.latitude_deg, request.prior.sigma_horizontal_m) == (49.01, 25.0)
    assert refused.returncode == 1
    assert refused.stderr.startswith("BAD_IMAGE: ")


def test_its_types_name_fields_of_the_reply() -> None:
    (body,) = re.findall(r"export type Reply = \{\n(.*?)\n\};", CLIENT.read_text("utf-8"), re.S)
    fields = re.findall(r"^  (\w+):", body, re.M)
    assert len(fields) > 10
    assert set(fields) <= set(LocaliseReply.model_fields)
