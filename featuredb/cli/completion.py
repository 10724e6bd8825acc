"""Subcommand `completion`: a script by which a shell completes commands, options and files."""

import argparse
import sys
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any


def register(subparsers: Any) -> None:
    completion = subparsers.add_parser(
        "completion",
        help="print a script for the shell's completion",
        description="Print a script by which a shell completes commands, options and files.",
    )
    completion.add_argument("shell", choices=("bash", "zsh", "tcsh"))
    completion.set_defaults(run=_print)


def _print(args: argparse.Namespace) -> None:
    import shtab

    from featuredb.cli.main import COMMAND_GROUP, build_parser

    parser = build_parser(entry_points(group=COMMAND_GROUP))
    for action in _actions(parser):
        if action.choices is None and (action.type is Path or action.dest == "db"):
            action.complete = shtab.FILE  # type: ignore[attr-defined]  # as shtab wants it
    sys.stdout.write(shtab.complete(parser, shell=args.shell))


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Of the parser and of all below it."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for child in action.choices.values():
                yield from _actions(child)
