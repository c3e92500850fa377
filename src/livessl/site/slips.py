"""Words slips in YAML: names without quotes, decimal commas, channels counted from 0."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import yaml

from livessl.site.place import Finding, Place

_TEXT: Final = "tag:yaml.org,2002:str"
_NULL: Final = "tag:yaml.org,2002:null"
_NUMBERS: Final = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
_MERGE: Final = "tag:yaml.org,2002:merge"

_KINDS: Final = {
    "tag:yaml.org,2002:bool": "true or false",
    "tag:yaml.org,2002:int": "a number",
    "tag:yaml.org,2002:float": "a number",
    "tag:yaml.org,2002:null": "nothing",
    "tag:yaml.org,2002:timestamp": "a date",
}
"""The value that YAML reads in place of a text without quotes, in words, by the tag of the node."""

_WITH_COMMA: Final = re.compile(r"[+-]?\d+,\d+")


def quote_keys(node: yaml.Node | None, place: Place = (), known: set[int] | None = None) -> Iterator[Finding]:
    """Turn the keys of all mappings into texts, in place, and yield those that YAML reads as something else.

    All keys of a site file are texts: `no`, `on`, `1` and `2024-01-31` are names that lack their quotes. In
    `{edge_m: 0,5}` YAML finds a key 5 without a value, which is taken for the decimals of the number before it.
    """
    known = set() if known is None else known
    if node is None or id(node) in known:
        return
    known.add(id(node))
    if isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            yield from quote_keys(value, (*place, index), known)
    if not isinstance(node, yaml.MappingNode):
        return
    kept: list[tuple[yaml.Node, yaml.Node]] = []
    for key, value in node.value:
        text = key.value
        if not isinstance(key, yaml.ScalarNode) or key.tag in (_TEXT, _MERGE):
            kept.append((key, value))
        elif key.tag in _NUMBERS and value.tag == _NULL and kept and kept[-1][1].tag in _NUMBERS:
            before, number = kept[-1]
            meant = f"{number.value}.{text}"
            yield (*place, before.value), f"expected a decimal point, got {number.value},{text}; write {meant}"
            number.value, number.tag = meant, _NUMBERS[1]
        else:
            yield (
                (*place, text),
                f"expected a name, got {text} without quotes, which is {_KINDS.get(key.tag, 'no text')} in YAML; "
                f'put the name in quotes: "{text}"',
            )
            key.tag = _TEXT
            kept.append((key, value))
        if kept and kept[-1][1] is value:
            yield from quote_keys(value, (*place, text if isinstance(text, str) else "?"), known)
    node.value = kept


def slip(error: Mapping[str, Any]) -> str | None:
    """Return the sentence for an error of pydantic that a slip explains; None for any other."""
    kind, got = error["type"], error.get("input")
    if kind == "too_long" and isinstance(got, list) and _has_commas(got):
        return (
            f"expected {error['ctx']['max_length']} numbers, got {len(got)}; write decimal points, not commas: "
            "2.5, not 2,5"
        )
    if kind in ("float_parsing", "int_parsing") and isinstance(got, str) and _WITH_COMMA.fullmatch(got):
        return f"expected a decimal point, got {got}; write {got.replace(',', '.')}"
    if kind == "string_type" and (got is None or isinstance(got, bool | int | float)):
        return f"expected a text, got {got!r}; put it in quotes"
    return None


def counted_from_0(arrays: Mapping[str, Sequence[int]]) -> str | None:
    """Return what is wrong with the channels of a node, which count from 1; None if nothing is."""
    lowest = min((channel for channels in arrays.values() for channel in channels), default=1)
    if lowest >= 1:
        return None
    what = f"expected channel numbers from 1 on, got {lowest}; channels count from 1"
    if lowest < 0:
        return what
    meant = ", ".join(f"{name}: {[channel + 1 for channel in channels]}" for name, channels in arrays.items())
    return f"{what}; did you mean {{{meant}}}?"


def _has_commas(numbers: list[Any]) -> bool:
    """Return whether a list looks like numbers that decimal commas have divided: at least two of them are whole."""
    return all(type(x) in (int, float) for x in numbers) and sum(type(x) is int for x in numbers) >= 2
