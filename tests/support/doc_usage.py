"""Commands of the documentation that are not run: their own program reads their arguments, and no more."""

import argparse
import re
import runpy
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from importlib.metadata import entry_points, metadata
from typing import Any, NoReturn
from unittest.mock import patch

from featuredb.cli.main import COMMAND_GROUP, build_parser
from tests.support.doc_commands import ROOT, Call, Command, begins_with_program, call_of

# What the documentation writes where the reader has a number of his own.
_NUMBERS = {"N": "3", "K": "3", "V": "1", "M": "1.5"}


class UsageError(Exception):
    """A program does not take these arguments."""


class _Found(BaseException):
    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self.parser = parser


def check_usage(command: Command) -> None:
    """Let the command's program read its arguments.

    A command of a block must be complete; one in prose may leave arguments out.

    Raises:
        UsageError: what is wrong with it.
    """
    parts = [] if command.in_prose else command.text.split(" | ")
    if len(parts) > 1 and all(map(begins_with_program, parts)):
        for text in parts:
            check_usage(replace(command, text=text))
        return
    call = call_of(command)
    unknown = set(call.extras) - set(metadata("featuredb").get_all("Provides-Extra") or ())
    if unknown:
        raise UsageError(f"{command}: no such extra: {', '.join(sorted(unknown))}")
    if call.program not in ("featuredb", "mkdocs") and not call.program.startswith("tools/"):
        return
    try:
        _read(call, complete=not command.in_prose)
    except UsageError as error:
        raise UsageError(f"{command}: {error}") from error


def _read(call: Call, *, complete: bool) -> None:
    words = [_with_numbers(word) for word in call.arguments]
    if call.program == "mkdocs":
        _read_by_mkdocs(words)
        return
    parser = _featuredb() if call.program == "featuredb" else parser_of_tool(call.program)
    known = _options(parser, words)
    for word in words:
        if word.startswith("--") and word.partition("=")[0] not in known:
            raise UsageError(f"no option {word}")
    with _errors_raised():
        try:
            parser.parse_args(words)
        except UsageError as error:
            # The least that prose must get right: subcommands, options, and the values that it gives.
            if complete or not re.search("are required|expected (one|at least one) argument", str(error)):
                raise


def _with_numbers(word: str) -> str:
    return ",".join(_NUMBERS.get(part, part) for part in word.split(","))


@cache
def _featuredb() -> argparse.ArgumentParser:
    return build_parser(entry_points(group=COMMAND_GROUP))


@cache
def parser_of_tool(file: str) -> argparse.ArgumentParser:
    """The parser of a program in tools/: it is started, and stopped when it would read its arguments."""

    def stop(parser: argparse.ArgumentParser, *_: Any, **__: Any) -> NoReturn:
        raise _Found(parser)

    if not (ROOT / file).is_file():
        raise UsageError(f"no file {file}")
    with patch.object(sys, "argv", [file]), patch.object(argparse.ArgumentParser, "parse_args", stop):
        try:
            runpy.run_path(str(ROOT / file), run_name="__main__")
        except _Found as found:
            return found.parser
    raise UsageError(f"{file} reads no arguments")


def _options(parser: argparse.ArgumentParser, words: Sequence[str]) -> set[str]:
    """Options of the parser, and of those of the subcommands that the words choose."""
    known = set(parser._option_string_actions)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for i, word in enumerate(words):
                if word in action.choices:
                    return known | _options(action.choices[word], words[i + 1 :])
    return known


@contextmanager
def _errors_raised() -> Iterator[None]:
    def error(parser: argparse.ArgumentParser, message: str) -> NoReturn:
        raise UsageError(f"{parser.prog}: {message}")

    with patch.object(argparse.ArgumentParser, "error", error):
        yield


def _read_by_mkdocs(words: list[str]) -> None:
    import click
    from mkdocs.__main__ import cli

    try:
        cli.commands[words[0]].make_context(words[0], words[1:])
    except (KeyError, click.UsageError) as error:
        raise UsageError(str(error)) from error
