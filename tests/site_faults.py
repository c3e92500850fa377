"""Faults of a site file, and the lines on which they are expected."""

from __future__ import annotations

import pytest

from livessl.errors import ConfigError
from livessl.site.load import parse_site


def faults_of(text: str) -> list[tuple[str, str]]:
    """Return place and sentence of every fault of a text."""
    with pytest.raises(ConfigError) as caught:
        parse_site(text, "site.yaml")
    return [(fault.where, fault.what) for fault in caught.value.faults]


def line_of(text: str, path: str) -> int | None:
    """Return the number of the line of a dotted path, or of the longest part of it that the text has."""
    lines = text.splitlines()
    number = None
    for level, key in enumerate(path.split(".")):
        start = 0 if number is None else number + 1
        if key.isdigit():
            item = start + int(key)
            return item + 1 if lines[item].lstrip().startswith("- ") else start
        wanted = f"{'  ' * level}{key}:"
        number = next((n for n in range(start, len(lines)) if lines[n].startswith(wanted)), None)
        if number is None:
            return start or None
    return None if number is None else number + 1


ARRAY = "arrays.north"
NODE = "nodes.lab-pc"
JOINT = "joint.both"
