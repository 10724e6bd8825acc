"""The database on a local disk."""

from pathlib import Path

import pytest

from tests.support.store_suite import Place, StoreSuite


class TestLocalStore(StoreSuite):
    @pytest.fixture
    def place(self, tmp_path: Path) -> Place:
        return Place(url=str(tmp_path / "maps.db"))
