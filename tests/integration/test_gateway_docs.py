"""The programs in docs/gateway.md run as they stand there, apart from the port; its figures are ours."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from reloc.gateway.failures import RETRY_AFTER_S, STATUS_OF
from reloc.gateway.options import GatewayOptions
from tests.support.gateway import running_gateway
from tests.support.service import ScriptedLocaliser, photo, running_server

_TEXT = (Path(__file__).parents[2] / "docs" / "gateway.md").read_text(encoding="utf-8")


def programs(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", _TEXT, flags=re.DOTALL)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with the photo of the programs; a function that puts the port into them."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photo.jpg").write_bytes(photo())
    with (
        running_server(ScriptedLocaliser(1)) as server,
        running_gateway(server.endpoints[0]) as gateway,
    ):

        def placed(program: str) -> str:
            assert "http://127.0.0.1:8080/" in program
            return program.replace("http://127.0.0.1:8080", gateway.url)

        yield placed


def test_the_python_client_runs(here, capsys):
    (program,) = programs("python")
    exec(compile(here(program), "docs/gateway.md", "exec"), {})
    assert re.match(r"\{'lat': 49\.0\d+, 'lon': 8\.4\d+, 'h': .*'position': 0\.1", capsys.readouterr().out)


@pytest.mark.skipif(shutil.which("curl") is None, reason="curl is not installed")
def test_the_curl_lines_run(here):
    form, geopose = (
        subprocess.run(["sh", "-c", here(line)], capture_output=True, check=True, timeout=60).stdout
        for line in programs("sh")
        if "curl" in line
    )
    assert json.loads(form)["status"] == "localised"
    assert json.loads(geopose)["geopose"]["position"]["lat"] == pytest.approx(49.0, abs=0.1)
    assert json.loads(geopose)["id"] == "q-1"


def test_the_table_of_errors_is_that_of_the_program():
    said: dict[str, set[int]] = {}
    for statuses, codes in re.findall(r"^\| ([\d, ]+) \| (`[A-Z_`, ]+`) \|", _TEXT, flags=re.MULTILINE):
        numbers, names = re.findall(r"\d+", statuses), re.findall(r"[A-Z_]+", codes)
        pairs = zip(numbers, names, strict=True) if len(numbers) > 1 else ((numbers[0], n) for n in names)
        for number, name in pairs:
            said.setdefault(name, set()).add(int(number))
    assert said.pop("INTERNAL") == {500, STATUS_OF["INTERNAL"]}
    assert said == {code: {status} for code, status in STATUS_OF.items() if code != "INTERNAL"}
    assert {STATUS_OF[code] for code in RETRY_AFTER_S} == {503}


def test_the_figures_are_those_of_the_program():
    options = GatewayOptions()
    for said in (
        f"`--max-in-flight N` ({options.max_in_flight})",
        f"`--timeout SECONDS` ({options.timeout_s:g}, per photo)",
        f"a body over {options.max_body_bytes >> 20} MiB, an image over {options.max_image_bytes >> 20} MiB",
        f"the body took longer than {options.body_timeout_s:g} s",
        f"At most {options.max_in_flight} photos are in hand and {options.max_buffered_bytes >> 20} MiB",
        f"at least {options.prior_floor_m:g} m; {options.prior_unknown_m:g} m if it is missing",
    ):
        assert said in _TEXT
