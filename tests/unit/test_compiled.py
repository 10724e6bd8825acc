"""Loops are compiled where nothing can be kept, too."""

import logging
from typing import Any

import numba
import pytest

from featuredb.compiled import compiled


def test_where_no_folder_can_be_written_to_it_is_compiled_and_said(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    honest = numba.njit

    def njit(*given: Any, cache: bool = False, **options: Any) -> Any:
        if cache:
            raise RuntimeError("cannot cache function 'twice': no locator available")
        return honest(*given, **options)

    monkeypatch.setattr(numba, "njit", njit)

    def twice(number: int) -> int:
        return 2 * number

    with caplog.at_level(logging.WARNING):
        made = compiled(twice)
        compiled(twice)
    assert made(21) == 42
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "NUMBA_CACHE_DIR" in caplog.text
