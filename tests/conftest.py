"""Fixtures that several test folders share."""

import os
from pathlib import Path

import pytest

_STUDIES = "evaluation"
REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real photo sets beside the repository; the test is skipped where it is absent."""
    folder = REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the real photo sets are not there: {folder}")
    return folder


@pytest.fixture(scope="session", autouse=True)
def user_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Nothing of the tests stays in the user's cache, and nothing of it comes into them."""
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--evaluations", action="store_true", help="run the long studies, and nothing else")


def pytest_configure(config: pytest.Config) -> None:
    """No file is waited for until it is on the disk: a killed process loses nothing that it has written.

    Only a power cut does, which no test makes, and an ingest writes hundreds of files.
    """
    os.fsync = lambda fd: None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Studies are rows of the scoreboard; a run of the tests counts them as deselected."""
    wanted = bool(config.getoption("--evaluations"))
    others = [item for item in items if (item.get_closest_marker(_STUDIES) is not None) != wanted]
    config.hook.pytest_deselected(items=others)
    items[:] = [item for item in items if item not in others]
