"""JSON Schemas of the tables (`tables/`) and of the messages on the wire (`wire/`): data and a loader."""

import json
from importlib.resources import files
from typing import Any


def load_schema(name: str) -> dict[str, Any]:
    """A schema by its path without the ending, for example "tables/maps" or "wire/reply".

    Raises:
        KeyError: there is no schema of that name.
    """
    resource = files(__name__).joinpath(*f"{name}.json".split("/"))
    if not resource.is_file():
        raise KeyError(f"no schema {name!r}; expected one of {', '.join(schema_names())}")
    schema: dict[str, Any] = json.loads(resource.read_text(encoding="utf-8"))
    return schema


def schema_names() -> list[str]:
    """Names of all schemas."""
    return sorted(
        f"{folder.name}/{file.name.removesuffix('.json')}"
        for folder in files(__name__).iterdir()
        if folder.is_dir()
        for file in folder.iterdir()
        if file.name.endswith(".json")
    )
