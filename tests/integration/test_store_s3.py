"""The database in an object store: the same suite over S3-compatible servers on loopback."""

import subprocess
import sys
import tempfile
import uuid
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.support.growth_suite import DecisionsSuite, GrowthSuite
from tests.support.maps import random_map
from tests.support.s3_server import BUCKET, ceph_gateway, missing_ceph_programs, moto_server
from tests.support.store_suite import ChangesSuite, Place, StoreSuite

pytestmark = [pytest.mark.s3, pytest.mark.slow]


def _new_place(options: dict[str, str]) -> Place:
    return Place(url=f"s3://{BUCKET}/{uuid.uuid4().hex}", storage_options=options)


@pytest.fixture(scope="module")
def ceph() -> Iterator[dict[str, str]]:
    missing = missing_ceph_programs()
    if missing:
        pytest.skip(
            f"Ceph is not installed (no {', '.join(missing)}): apt-get install radosgw ceph-mon ceph-osd"
        )
    # Not pytest's folder: a socket's path may have 107 characters.
    with tempfile.TemporaryDirectory(prefix="ceph") as folder, ceph_gateway(Path(folder)) as options:
        yield options


@pytest.fixture(scope="module")
def moto() -> Iterator[dict[str, str]]:
    if find_spec("moto") is None or find_spec("flask") is None:
        pytest.skip("moto is not installed: pip install 'moto[server]'")
    with moto_server() as options:
        yield options


class TestCephStore(ChangesSuite):
    """Ceph's Object Gateway: a production object store."""

    @pytest.fixture
    def place(self, ceph: dict[str, str]) -> Place:
        return _new_place(ceph)

    def test_the_command_reaches_it(self, place: Place) -> None:
        place.create().commit_map(random_map(1))
        options = [f"--storage-option={k}={v}" for k, v in place.storage_options.items()]
        query = ["sql", place.url, "select count(*) as n from points", "--format", "csv"]
        command = [sys.executable, "-m", "featuredb.cli", *query, *options]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert (done.returncode, done.stdout) == (0, "n\n60\n"), done.stderr


class TestMotoStore(StoreSuite):
    """moto, which a test machine without Ceph has."""

    @pytest.fixture
    def place(self, moto: dict[str, str]) -> Place:
        return _new_place(moto)


class TestMotoInbox(GrowthSuite):
    @pytest.fixture
    def place(self, moto: dict[str, str]) -> Place:
        return _new_place(moto)


@pytest.mark.evaluation
class TestMotoChanges(ChangesSuite, TestMotoStore):
    """Changes are the same code on a local disk, where each run of the tests asks."""


@pytest.mark.evaluation
class TestMotoDecisions(DecisionsSuite, TestMotoInbox):
    """As `TestMotoChanges`."""
