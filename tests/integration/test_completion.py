"""What the shell is told: completion of commands, options and files, and defaults of the environment."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from reloc.wire.endpoints import DEFAULT_ENDPOINT


def run(*argv: str, **environment: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-m", "featuredb.cli", *argv],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120.0,
    )


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not here")
def test_bash_completes_commands_options_and_files(tmp_path: Path) -> None:
    script = tmp_path / "completion.sh"
    script.write_text(run("completion", "bash").stdout)
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


def test_the_environment_says_which_server_is_asked(tmp_path: Path) -> None:
    photo = tmp_path / "photo.jpg"
    photo.write_bytes(b"never sent")
    done = run("query", str(photo), "--timeout", "1", FEATUREDB_CONNECT="tcp/127.0.0.1:9")
    assert done.returncode == 2
    assert "tcp/127.0.0.1:9" in done.stderr


def test_an_empty_variable_says_nothing() -> None:
    code = (
        "import argparse; from reloc.cli.commands import add_server_arguments as add\n"
        "parser = argparse.ArgumentParser(); add(parser); args = parser.parse_args([]); "
        "print(args.connect, args.database)"
    )
    environment = {**os.environ, "FEATUREDB_CONNECT": "", "FEATUREDB_DATABASE": ""}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == [DEFAULT_ENDPOINT, "None"]
