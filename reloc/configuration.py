"""Zenoh's configuration files."""

import json
import os
import re
from pathlib import Path

import zenoh

from featuredb.errors import InvalidValueError


def read_configuration(path: Path) -> zenoh.Config:
    """What `--config` names.

    Raises:
        InvalidValueError: there is no such file, it is no configuration, or a file that it names is missing.
    """
    try:
        config = zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        raise InvalidValueError(
            f"--config: expected a Zenoh configuration (.json5) in {path}, found: {first_sentence(error)}; "
            "`featuredb keys init DIR` makes those of a server and its clients"
        ) from error
    for key, named in json.loads(config.get_json("transport/link/tls")).items():
        # Zenoh reads them when it connects, and says only that nobody answers.
        if key.endswith(("_certificate", "_private_key")) and named and not os.access(named, os.R_OK):
            raise InvalidValueError(
                f"--config: {path}: tls/{key}: expected a file that can be read, found none at {named}; "
                "correct the path, which counts from the working folder"
            )
    return config


def first_sentence(error: Exception) -> str:
    """Zenoh's message in one line, without the source lines of its own and of the file that it shows."""
    said = " ".join(str(error).split(" at /")[0].split())
    return re.sub(r"^--> (\S+) .* = ", r"at \1 ", said)
