"""The programs in docs/wire.md run as they stand there, apart from the port."""

import ast
import re
from pathlib import Path

from reloc.service.contributions.inbox import InboxOptions
from reloc.service.options import LiveOptions
from tests.support.service import ScriptedLocaliser, photo, running_server

_WIRE = Path(__file__).parents[2] / "docs" / "wire.md"


def programs() -> list[str]:
    return re.findall(r"```python\n(.*?)```", _WIRE.read_text(encoding="utf-8"), flags=re.DOTALL)


def run(program: str, folder: Path, monkeypatch) -> None:
    monkeypatch.chdir(folder)
    (folder / "photo.jpg").write_bytes(photo())
    with running_server(ScriptedLocaliser(1)) as server:
        code = program.replace("tcp/127.0.0.1:7447", server.endpoints[0])
        assert code != program
        exec(compile(code, "docs/wire.md", "exec"), {})


def test_a_client_needs_nothing_but_zenoh_and_a_dozen_lines(tmp_path, monkeypatch, capsys):
    program = programs()[0]
    imported = {
        alias.name
        for node in ast.walk(ast.parse(program))
        if isinstance(node, ast.Import)
        for alias in node.names
    }
    assert imported == {"json", "zenoh"}
    assert not any(isinstance(node, ast.ImportFrom) for node in ast.walk(ast.parse(program)))
    assert len([line for line in program.splitlines() if line.strip()]) <= 12
    run(program, tmp_path, monkeypatch)
    out = capsys.readouterr().out
    assert out.startswith("localised {'epsg': 32632")


def test_the_bounds_of_the_inbox_are_those_of_the_program():
    text, bounds = _WIRE.read_text(encoding="utf-8"), InboxOptions()
    for said in (
        f"photos wait to be written ({bounds.max_queue}, or {bounds.max_queued_bytes >> 20} MiB)",
        f"{bounds.max_owner_photos:,} photos of this owner",
        f"{bounds.max_photos:,} photos wait, or {bounds.max_stored_bytes >> 30} GiB are stored",
    ):
        assert said in text


def test_the_python_client_of_the_documentation_runs(tmp_path, monkeypatch, capsys):
    run(programs()[1], tmp_path, monkeypatch)
    out = capsys.readouterr().out
    assert out.startswith("localised")
    assert "received=1" in out


def test_the_live_client_of_the_documentation_runs(tmp_path, monkeypatch, capsys):
    run(programs()[2], tmp_path, monkeypatch)
    out = capsys.readouterr().out
    assert out.startswith("0 lost nothing was localised yet")


def test_what_is_said_of_live_sessions_is_what_the_program_does():
    text, options = _WIRE.read_text(encoding="utf-8"), LiveOptions()
    assert f"`--live-sessions` ({options.max_sessions})" in text
    assert f"(`--live-idle`, {options.idle_timeout_s:g} s)" in text
