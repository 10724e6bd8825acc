"""The command `featuredb` in this process, with some of its subcommands only."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import EntryPoint

import pytest

from featuredb.cli.main import COMMAND_GROUP


@contextmanager
def only_command(monkeypatch: pytest.MonkeyPatch, name: str, register: str) -> Iterator[None]:
    """As if only one group of subcommands were installed; logging is afterwards what it was before.

    Args:
        name: of the entry point. register: its function, as "module:function".
    """
    command = EntryPoint(name, register, COMMAND_GROUP)
    monkeypatch.setattr("featuredb.cli.main.entry_points", lambda group: [command])
    root, package = logging.getLogger(), logging.getLogger("featuredb")
    handlers, level, package_level = list(root.handlers), root.level, package.level
    try:
        yield
    finally:
        root.handlers[:] = handlers
        root.setLevel(level)
        package.setLevel(package_level)
