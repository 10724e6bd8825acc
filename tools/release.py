"""Make a release: sdist and wheel, tried in an environment that has nothing else, then published.

    python -m tools.release [--publish]

1. The tree is clean, and CHANGELOG.md has a section of pyproject.toml's version.
2. `uv build`; the wheel that is made of the sdist has the same files.
3. The wheel goes into a new environment without extras: its version, its names, a database, completion.
4. With --publish: `uv publish`, and a tag. Without, what would be done is said.
"""

import argparse
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from pathlib import Path

_ROOT = Path(__file__).resolve().parent.parent


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--publish", action="store_true", help="tag and publish; default: a dry run")
    publish = parser.parse_args().publish
    version = tomllib.loads((_ROOT / "pyproject.toml").read_text())["project"]["version"]
    problems = _problems(version)
    for problem in problems:
        sys.stdout.write(f"not ready: {problem}\n")
    if problems and publish:
        return 1
    with tempfile.TemporaryDirectory() as scratch:
        wheel = _built(Path(scratch))
        _tried(wheel, Path(scratch) / "env", version)
        last = (("uv", "publish", str(wheel), str(_sdist(Path(scratch)))), ("git", "tag", f"v{version}"))
        for command in last:
            sys.stdout.write(f"{'' if publish else 'would run: '}{' '.join(command)}\n")
            if publish:
                _run(*command)
    return 1 if problems else 0


def _problems(version: str) -> list[str]:
    """What stands in the way of a release."""
    found = []
    if _run("git", "status", "--porcelain"):
        found.append("the tree has changes; commit them")
    if f"## [{version}]" not in (_ROOT / "CHANGELOG.md").read_text(encoding="utf-8"):
        found.append(f"CHANGELOG.md has no section [{version}]")
    return found


def _built(folder: Path) -> Path:
    """The wheel, after it was compared with the one that the sdist gives."""
    _run("uv", "build", "--wheel", "--out-dir", str(folder / "tree"), str(_ROOT))
    _run("uv", "build", "--sdist", "--out-dir", str(folder / "sdist"), str(_ROOT))
    _run("uv", "build", "--wheel", "--out-dir", str(folder / "again"), str(_sdist(folder)))
    (wheel,), (again,) = (list((folder / name).glob("*.whl")) for name in ("tree", "again"))
    files = [set(zipfile.ZipFile(one).namelist()) for one in (wheel, again)]
    if files[0] != files[1]:
        raise SystemExit(f"the sdist gives another wheel: {sorted(files[0] ^ files[1])[:5]}")
    sys.stdout.write(f"{wheel.name}: {len(files[0])} files, {wheel.stat().st_size / 1e6:.1f} MB\n")
    return wheel


def _sdist(folder: Path) -> Path:
    (found,) = (folder / "sdist").glob("*.tar.gz")
    return found


def _tried(wheel: Path, environment: Path, version: str) -> None:
    """Install it without extras, and use it."""
    _run("uv", "venv", "--python", sys.executable, str(environment))
    _run("uv", "pip", "install", "--python", str(environment), str(wheel))
    program, database = str(environment / "bin" / "featuredb"), str(environment / "maps.db")
    if version not in _run(program, "--version"):
        raise SystemExit(f"expected version {version}")
    python = str(environment / "bin" / "python")
    _run(python, "-I", "-c", "import featuredb; featuredb.open; featuredb.Camera")
    for words in (("init", database), ("maps", database), ("verify", database), ("completion", "bash")):
        _run(program, *words)
    sys.stdout.write("the wheel works without extras\n")


def _run(*command: str) -> str:
    done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
