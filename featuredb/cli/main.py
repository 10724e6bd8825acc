"""`featuredb`: finds the subcommands, parses, runs, and turns errors into messages and exit codes.

A package adds subcommands by an entry point of the group "featuredb.commands" that names a function
`register(subparsers)`. It calls `subparsers.add_parser(...)` and `parser.set_defaults(run=function)`;
`function(args)` does the work and returns an exit code, None for 0. It raises FeatureDbError for what a user
can do something about. There is an entry point for every subcommand, of its name, so that only the module of
the one that runs is loaded; several may name the same function.

Exit codes: 0 done; 1 done, and the answer is no (damage found, not localised); 2 wrong usage or a
FeatureDbError, or a disk or a right that is missing; 70 a defect of the program; 130 interrupted.
"""

import argparse
import errno
import logging
import os
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import EntryPoint, entry_points, version
from typing import Any

from featuredb.errors import FeatureDbError
from featuredb.extras import leave_out_pandas

logger = logging.getLogger(__name__)

COMMAND_GROUP = "featuredb.commands"
EXIT_ERROR, EXIT_DEFECT, EXIT_INTERRUPTED = 2, 70, 130  # 1: the command itself says no
# Errors of the system that no program can prevent: its disks, rights and limits.
_OF_THE_MACHINE = (
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO),
    *(errno.EMFILE, errno.ENFILE, errno.ENAMETOOLONG),
)

Register = Callable[[Any], None]


def program() -> int:
    """`featuredb` as a process of its own: run the command line and return its exit code."""
    leave_out_pandas()
    return main()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    common, rest = _common_parser().parse_known_args(sys.argv[1:] if argv is None else list(argv))
    _configure_logging("DEBUG" if common.debug else "WARNING")
    parser = build_parser(needed_for(rest, entry_points(group=COMMAND_GROUP)))
    try:
        args = parser.parse_args(rest)
    except SystemExit as stop:  # argparse has printed help or the error
        return int(stop.code or 0)
    return run_command(args.run, args)


def needed_for(argv: Sequence[str], commands: Iterable[EntryPoint]) -> list[EntryPoint]:
    """The commands that the arguments need: those of the name that comes first, all where there are none."""
    known = list(commands)
    return [c for c in known if c.name in argv[:1]] or known


def build_parser(commands: Iterable[EntryPoint]) -> argparse.ArgumentParser:
    """The parser with all subcommands that can be loaded; one that cannot is reported and left out."""
    parser = argparse.ArgumentParser(
        prog="featuredb",
        description="Geo-registered feature maps and visual relocalisation.",
        parents=[_common_parser()],
    )
    parser.add_argument("--version", action="version", version=f"featuredb {version('featuredb')}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    tried = set()
    for command in sorted(commands, key=lambda c: c.name):
        if command.value in tried:
            continue
        tried.add(command.value)
        try:
            register: Register = command.load()
            register(subparsers)
        except Exception as error:  # a plugin may fail in any way, and the others must live
            logger.warning("commands %r are not available: %s: %s", command.name, type(error).__name__, error)
            logger.debug("loading %s failed", command.value, exc_info=True)
    return parser


def run_command(run: Callable[[argparse.Namespace], int | None], args: argparse.Namespace) -> int:
    """Run one subcommand; errors become one line on stderr, with a traceback only when debugging."""
    try:
        code = run(args)
        sys.stdout.flush()
        return code or 0
    except FeatureDbError as error:
        logger.debug("%s", error, exc_info=True)
        sys.stderr.write(f"featuredb: {error}\n")
        return EXIT_ERROR
    except KeyboardInterrupt:
        sys.stderr.write("featuredb: interrupted\n")
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # The reader of our output (`| head`) has seen enough. Python would complain again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        number = isinstance(error, OSError) and (error.errno or _errno_in(str(error)))
        if number in _OF_THE_MACHINE:
            logger.debug("%s", error, exc_info=True)
            sys.stderr.write(_refused(error, number))
            return EXIT_ERROR
        logger.exception("a defect of the program; please report it with the lines below")
        return EXIT_DEFECT


def _errno_in(text: str) -> int | None:
    """What a library that is not written in Python says of the system's error."""
    found = re.search(r"os error (\d+)", text)
    return int(found[1]) if found else None


def _refused(error: Exception, number: int) -> str:
    where = getattr(error, "filename", None) or "a file"
    return (
        f"featuredb: cannot read or write {where}: {os.strerror(number)}; free space there, get the right to "
        "use it, or choose another place\n"
    )


def _common_parser() -> argparse.ArgumentParser:
    """Options that stand anywhere on the command line."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--debug", action="store_true", help="log everything, show tracebacks of errors")
    return parser


def _configure_logging(level: str) -> None:
    """Log to stderr; the libraries below only speak when something is wrong."""
    logging.basicConfig(
        stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s", level=logging.WARNING
    )
    for package in ("featuredb", "ingest", "reloc"):
        logging.getLogger(package).setLevel(level)
