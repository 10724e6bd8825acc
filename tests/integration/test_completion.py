"""What the shell is told: completion of commands, options and files, and defaults of the environment."""

import argparse
import shutil
import subprocess
from pathlib import Path

import pytest

from featuredb.cli.main import main
from reloc.cli.commands import add_server_arguments
from reloc.client import Client
from reloc.wire.keys import DEFAULT_ENDPOINT


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not here")
def test_bash_completes_commands_options_and_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / "completion.sh"
    assert main(["completion", "bash"]) == 0
    script.write_text(capsys.readouterr().out)
    (tmp_path / "photo.jpg").touch()

    def completed(*words: str) -> list[str]:
        line = " ".join(f"'{word}'" for word in words)
        code = (
            f"source {script}; COMP_WORDS=({line}); COMP_CWORD={len(words) - 1}; "
            "_shtab_featuredb; echo ${COMPREPLY[@]}"
        )
        done = subprocess.run(["bash", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
        return done.stdout.split()

    assert completed("featuredb", "inge") == ["ingest"]
    assert "--overlay" in completed("featuredb", "localise", "--ov")
    assert "photo.jpg" in completed("featuredb", "localise", "pho")


def test_the_environment_says_which_server_is_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    photo = tmp_path / "photo.jpg"
    photo.write_bytes(b"never sent")
    monkeypatch.setitem(Client.__init__.__kwdefaults__, "connect_timeout_s", 0.5)
    monkeypatch.setenv("FEATUREDB_CONNECT", "tcp/127.0.0.1:9")
    assert main(["query", str(photo)]) == 2
    assert "tcp/127.0.0.1:9" in capsys.readouterr().err


def test_an_empty_variable_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FEATUREDB_CONNECT", "")
    monkeypatch.setenv("FEATUREDB_DATABASE", "")
    parser = argparse.ArgumentParser()
    add_server_arguments(parser)
    found = parser.parse_args([])
    assert (found.connect, found.database) == (DEFAULT_ENDPOINT, None)
