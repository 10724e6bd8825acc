"""Digests of options and inputs: the keys under which stages find their earlier results."""

import dataclasses
import hashlib
import json
from typing import Any


def options_fingerprint(*options: Any) -> str:
    """Hex digest (16 characters) of option dataclasses: their class names, field names and values."""
    parts = [{"class": type(o).__qualname__, **dataclasses.asdict(o)} for o in options]
    text = json.dumps(parts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def digest(*texts: str) -> str:
    """Hex digest (64 characters) of texts; the separator cannot occur in names or digests."""
    return hashlib.sha256("\x1f".join(texts).encode()).hexdigest()
