"""Zenoh's configuration files."""

import json
import os
import re
from pathlib import Path

import zenoh

from featuredb.errors import InvalidValueError

# What Zenoh reads when it connects; of a missing one it says no more than that nobody answers.
_FILES = (
    *(
        f"transport/link/tls/{side}_{kind}"
        for side in ("listen", "connect")
        for kind in ("certificate", "private_key")
    ),
    "transport/link/tls/root_ca_certificate",
    "transport/auth/usrpwd/dictionary_file",
)


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
    for key in _FILES:
        named = json.loads(config.get_json(key))
        if named is not None and not os.access(named, os.R_OK):
            raise InvalidValueError(
                f"--config: {path}: {key}: expected a file that can be read, found none at {named}; correct "
                "the path, which counts from the working folder"
            )
    return config


def first_sentence(error: Exception) -> str:
    """Zenoh's message in one line, without the source lines of its own and of the file that it shows."""
    said = " ".join(str(error).split(" at /")[0].split())
    return re.sub(r"^--> (\S+) .* = ", r"at \1 ", said)
