"""Zenoh's configuration files."""

import re
from pathlib import Path

import zenoh

from featuredb.errors import InvalidValueError


def read_configuration(path: Path) -> zenoh.Config:
    """What `--config` names.

    Raises:
        InvalidValueError: there is no such file, or it is no configuration.
    """
    try:
        return zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        raise InvalidValueError(
            f"--config: expected a Zenoh configuration (.json5) in {path}, found: {first_sentence(error)}; "
            "`featuredb keys init DIR` makes those of a server and its clients"
        ) from error


def first_sentence(error: Exception) -> str:
    """Zenoh's message in one line, without the source lines of its own and of the file that it shows."""
    said = " ".join(str(error).split(" at /")[0].split())
    return re.sub(r"^--> (\S+) .* = ", r"at \1 ", said)
