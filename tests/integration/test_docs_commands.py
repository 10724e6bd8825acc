"""Every command line of the documentation is run, or at least read by its own program; none is left out."""

import atexit
import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import nbformat
import pytest
from _pytest.mark import ParameterSet
from IPython.core.inputtransformer2 import TransformerManager
from IPython.core.interactiveshell import InteractiveShell
from traitlets.config import Config

from tests.support.doc_commands import (
    ROOT,
    Block,
    Command,
    begins_with_program,
    blocks,
    call_of,
    commands,
    pages,
    prose,
)
from tests.support.doc_folder import go_on, inside, make_folder
from tests.support.doc_runner import CommandFailedError, PageRun, is_free, ports
from tests.support.doc_short import shorten
from tests.support.doc_usage import UsageError, check_usage

_REAL_DATA = "needs photos or scans that are not in the repository"
_BY_HAND = "needs a person's clicks; tools/paper.py runs the same with picks, tests/browser the page"
# Commands of blocks that are not run, by their beginning, and why. Their programs read their arguments.
NOT_RUN = {
    "featuredb ingest video film.db": _BY_HAND,
    "featuredb lidar add film.db": _BY_HAND,
    "featuredb anchor film.db": _BY_HAND,
    "featuredb anchor my.db MAP --photos ~/photos/park --near": "tests/integration/test_anchor_near.py does",
    "featuredb track film.db": _BY_HAND,
    "featuredb localise film.db": _BY_HAND,
    "featuredb live /dev/video0": "needs a camera; tests/unit/test_bridge.py sends what it would",
    "featuredb demo": "tests/integration/test_demo.py runs it",
    "tools/check.py": "it runs these tests",
    "haproxy": "tests/integration/test_proxy.py runs it",
    "apt-get install": "installs; .ci/run does",
    "pip install": "installs; the extra is looked up",
    "uv sync": "installs; these tests run in what it makes",
    "source": "these tests run in what it activates",
    "tools/frame_real_photos.py": _REAL_DATA,
    "tools/autzen_windows.py": _REAL_DATA,
}
# Python of these pages is run elsewhere, or is a fragment; it compiles in any case.
PYTHON_NOT_RUN = {
    "docs/wire.md": "tests/integration/test_service_docs.py runs it",
    "docs/gateway.md": "tests/integration/test_gateway_docs.py runs it",
    "docs/measurements/store.md": "fragments, with names for maps and photos of the reader's own",
}
# The page that makes the database; the others begin with what it leaves.
_FIRST = "docs/quickstart.md"
# What these show, others run part by part: placing by a scan test_anchor, test_anchor_near, test_picks_page;
# by control points docs/control-points.md; films and tracks test_ingest_video and test_track_command; growth
# and the gateway their own pages; the names in Python docs/python.md and test_python_api. Whole they are run
# with the studies.
_AT_NIGHT = {
    "docs/anchoring.md",
    "docs/video.md",
    "docs/tutorials/ar-developer.md",
    "docs/tutorials/community-host.md",
    "docs/tutorials/photogrammetrist.md",
    "film-and-scan",
    "service",
}
_LANGUAGES = {"sh", "python", "sql", "json", "text"}

_NOTEBOOK_FOLDER = ROOT / "docs" / "notebooks"
_NOTEBOOKS = sorted(_NOTEBOOK_FOLDER.glob("*.ipynb"))
_TEXTS = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in pages()}
_BLOCKS = [block for page, text in _TEXTS.items() for block in blocks(page, text)]
_COMMANDS = [command for block in _BLOCKS if block.language == "sh" for command in commands(block)]
_PROSE = [command for page, text in _TEXTS.items() for command in prose(page, text)]


def at_their_time(names: list[str]) -> list[ParameterSet]:
    """Parameters of a test, of which some are run with the studies."""
    return [pytest.param(n, id=n, marks=[pytest.mark.evaluation] * (n in _AT_NIGHT)) for n in names]


def why_not_run(command: Command) -> str | None:
    call = call_of(command)
    words = [call.program, *call.arguments]
    return next((why for start, why in NOT_RUN.items() if words[: len(start.split())] == start.split()), None)


def is_run(item: Command | Block) -> bool:
    if isinstance(item, Block):
        return item.language == "python" and item.page not in PYTHON_NOT_RUN
    return why_not_run(item) is None


def what_runs(page: str) -> list[Command | Block]:
    """Commands and Python of a page, in their order."""
    items = [item for item in [*_COMMANDS, *_BLOCKS] if item.page == page and is_run(item)]
    return sorted(items, key=lambda item: item.line)


def run_page(page: str, folder: Path) -> None:
    """Run what a page shows, in its order."""
    items = what_runs(page)
    lines = [item for item in items if isinstance(item, Command)]
    if taken := [port for port in ports(lines) if not is_free(port)]:
        pytest.skip(f"somebody listens on {taken}, where the commands of {page} would serve")
    if any("curl" in line.text for line in lines) and shutil.which("curl") is None:
        pytest.skip("curl is not installed")
    names: dict[str, object] = {"__name__": "__main__"}
    with inside(folder), PageRun(folder) as run:
        for item in items:
            if isinstance(item, Command):
                run.run(item)
            else:
                exec(compile(item.text, f"{item.page}:{item.line}", "exec"), names)


@contextmanager
def ipython(folder: Path) -> Iterator[InteractiveShell]:
    """A shell that runs the cells of a notebook as its kernel would."""
    settings = Config()
    settings.HistoryManager.enabled = False
    shell = InteractiveShell(config=settings, ipython_dir=str(folder / "ipython"))
    try:
        yield shell
    finally:
        atexit.unregister(shell.atexit_operations)
        shell.atexit_operations()
        shell.cleanup()


@pytest.fixture(scope="module")
def in_short(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch, tmp_path_factory.mktemp("work"))
        yield


@pytest.fixture(scope="module")
def after_first(in_short: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the simulated town, after all that the first page shows."""
    folder = make_folder(tmp_path_factory.mktemp("documentation"))
    run_page(_FIRST, folder)
    go_on(folder)
    return folder


@pytest.mark.slow
@pytest.mark.timeout(1200)  # it makes the town and its maps: three minutes on two free cores
def test_the_commands_of_the_first_page_run(after_first: Path) -> None:
    made = ("report/report.html", "overlay.png", "track.csv", "colmap/sparse", "opensfm/tracks.csv")
    assert [name for name in made if not (after_first / name).exists()] == []


@pytest.mark.slow
@pytest.mark.parametrize("page", at_their_time([p for p in _TEXTS if p != _FIRST and what_runs(p)]))
def test_the_commands_of_a_page_run(after_first: Path, tmp_path: Path, page: str) -> None:
    run_page(page, Path(shutil.copytree(after_first, tmp_path / "here")))


@pytest.mark.slow
@pytest.mark.parametrize("notebook", at_their_time([path.stem for path in _NOTEBOOKS]))
def test_a_notebook_runs(
    after_first: Path, tmp_path: Path, notebook: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In IPython in this process: a kernel of its own would import everything and register frames again."""
    stored = nbformat.read(_NOTEBOOK_FOLDER / f"{notebook}.ipynb", as_version=4)
    nbformat.validate(stored)
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    with inside(Path(shutil.copytree(after_first, tmp_path / "here"))), ipython(tmp_path) as shell:
        for cell in stored.cells:
            if cell.cell_type == "code":
                shell.run_cell(cell.source).raise_error()
                assert shell.user_ns.get("_exit_code", 0) == 0, cell.source


@pytest.mark.parametrize("notebook", _NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_stored_without_what_it_gave(notebook: Path) -> None:
    cells = [c for c in json.loads(notebook.read_text("utf-8"))["cells"] if c["cell_type"] == "code"]
    assert cells
    assert [c["outputs"] for c in cells if c["outputs"] or c["execution_count"] is not None] == []


@pytest.mark.parametrize("notebook", _NOTEBOOKS, ids=lambda path: path.stem)
def test_cells_of_a_notebook_are_read(notebook: Path) -> None:
    """As Python and as commands, whose words in braces are of the notebook's."""
    cells = [c.source for c in nbformat.read(notebook, as_version=4).cells if c.cell_type == "code"]
    for number, cell in enumerate(cells):
        compile(TransformerManager().transform_cell(cell), f"{notebook.name}:{number}", "exec")
        for line in cell.splitlines():
            if line.startswith("!"):
                check_usage(Command(notebook.name, number, line[1:]))


@pytest.mark.parametrize("command", [*_COMMANDS, *_PROSE], ids=str)
def test_a_program_takes_the_arguments_of_the_documentation(command: Command) -> None:
    check_usage(command)


@pytest.mark.parametrize("block", [b for b in _BLOCKS if b.language == "python"], ids=lambda b: b.page)
def test_python_compiles(block: Block) -> None:
    compile(block.text, f"{block.page}:{block.line}", "exec")


def test_no_command_hides_in_another_block() -> None:
    unknown = [f"{b.page}:{b.line}: {b.language!r}" for b in _BLOCKS if b.language not in _LANGUAGES]
    assert unknown == [], f"the info string of a block is one of {sorted(_LANGUAGES)}"
    hidden = [
        f"{block.page}:{block.line}: {line}"
        for block in _BLOCKS
        if block.language in ("text", "json")
        for line in block.text.splitlines()
        if begins_with_program(line)
    ]
    assert hidden == []


def test_what_is_not_run_is_in_the_documentation() -> None:
    used = Counter(why_not_run(command) for command in _COMMANDS)
    starts = [start for start in NOT_RUN if any(_begins(command, start) for command in _COMMANDS)]
    assert starts == list(NOT_RUN)
    assert {b.page for b in _BLOCKS if b.language == "python"} >= set(PYTHON_NOT_RUN)
    assert used[None] > sum(used.values()) / 2  # most commands of blocks are run


def _begins(command: Command, start: str) -> bool:
    call = call_of(command)
    return f"{' '.join([call.program, *call.arguments])} ".startswith(f"{start} ")


# The mechanism itself: what is wrong in a page fails.

_PAGE = """
Text with `featuredb maps my.db`, `featuredb` and `tools/check.py`.

```sh
featuredb maps \\
    my.db   # a remark
# nothing but a remark
printf '{"a":
1}' |
  cat
```

    featuredb indented
"""


def test_commands_are_found_and_joined() -> None:
    fence, indented = blocks("page.md", _PAGE)
    assert [(c.line, c.text.split()[0]) for c in commands(fence)] == [(5, "featuredb"), (8, "printf")]
    assert call_of(commands(fence)[0]).arguments == ("maps", "my.db")
    assert (indented.language, begins_with_program(indented.text)) == ("", True)
    assert [c.text for c in prose("page.md", _PAGE)] == ["featuredb maps my.db", "tools/check.py"]
    with pytest.raises(ValueError, match="ends before its command"):
        commands(Block("page.md", 1, "sh", "featuredb maps \\\n"))


@pytest.mark.parametrize(
    ("text", "in_prose", "wrong"),
    [
        ("featuredb maps my.db --gone", False, "no option --gone"),
        ("featuredb maps DB [--gone]", True, "no option --gone"),
        ("featuredb gone my.db", False, "invalid choice: 'gone'"),
        ("featuredb gone", True, "invalid choice: 'gone'"),
        ("featuredb maps", False, "required: DB"),
        ("featuredb maps my.db other.db", False, "unrecognized arguments: other.db"),
        ("uv run --extra gone featuredb maps my.db", False, "no such extra: gone"),
        ("pip install 'featuredb[gone]'", True, "no such extra: gone"),
        ("python -m tools.track_evaluation --on gone", False, "invalid choice: 'gone'"),
        ("tools/growth_community.py --gone 3", True, "no option --gone"),
        ("tools/gone.py", True, "no file tools/gone.py"),
        ("uv run --extra docs mkdocs gone", True, "gone"),
    ],
)
def test_wrong_usage_is_told(text: str, in_prose: bool, wrong: str) -> None:
    with pytest.raises(UsageError, match=wrong):
        check_usage(Command("page.md", 1, text, in_prose))


@pytest.mark.parametrize(
    "text", ["featuredb maps nowhere.db", "featuredb serve nowhere.db", "echo out; exit 3"]
)
def test_a_command_that_fails_is_told(tmp_path: Path, text: str) -> None:
    with inside(tmp_path), PageRun(tmp_path) as run, pytest.raises(CommandFailedError, match=r"page\.md:1: "):
        run.run(Command("page.md", 1, text))


def test_a_command_that_does_not_end_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.support.doc_runner._SHELL_S", 0.2)
    with inside(tmp_path), PageRun(tmp_path) as run, pytest.raises(subprocess.TimeoutExpired):
        run.run(Command("page.md", 1, "sleep 60"))
