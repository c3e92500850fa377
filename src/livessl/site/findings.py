"""Words faults of YAML files with line and place, unknown keys with "did you mean …?", duplicate keys."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final, TypeVar, get_args, get_origin

import yaml
from pydantic import BaseModel, ValidationError

from livessl.errors import ConfigError, Fault, did_you_mean
from livessl.site.place import Finding, Place
from livessl.site.slips import slip

_SENTENCES: Final = {
    "missing": "missing; add it",
    "greater_than": "expected a value greater than {gt:g}, got {got}",
    "greater_than_equal": "expected a value greater than or equal to {ge:g}, got {got}",
    "less_than": "expected a value less than {lt:g}, got {got}",
    "less_than_equal": "expected a value less than or equal to {le:g}, got {got}",
    "finite_number": "expected a finite number, got {got}",
    "literal_error": "expected {expected}, got {got}",
    "string_pattern_mismatch": "expected letters, digits, '.', '_' or '-' only, got {got}",
    "string_too_short": "expected at least {min_length} characters, got {got}",
    "string_too_long": "expected at most {max_length} characters, got {got}",
    "too_short": "expected at least {min_length} items, got {actual_length}",
    "too_long": "expected at most {max_length} items, got {actual_length}",
}
"""Sentence for each type of pydantic error; other types keep pydantic's own."""

MOST_NODES: Final = 1_000_000
"""Most values of a YAML file with its aliases replaced by what they stand for: a few lines can stand for billions."""

MOST_DIGITS: Final = 30
"""Most characters of a whole number; Python refuses to print numbers of thousands of digits."""

_INT: Final = "tag:yaml.org,2002:int"

Read = TypeVar("Read", bound=BaseModel)


_FOREIGN_UNITS: Final = {
    "mm": ("m", "millimetres"),
    "cm": ("m", "centimetres"),
    "ft": ("m", "feet"),
    "rad": ("deg", "radians"),
    "f": ("c", "degrees Fahrenheit"),
    "k": ("c", "kelvin"),
    "khz": ("hz", "kilohertz"),
    "ms": ("s", "milliseconds"),
    "us": ("s", "microseconds"),
}
"""Ends of keys in units that are not used, each with the end and the unit's name: the value must be converted, too."""

_MEANT: Final = re.compile(r"^unknown key .*; did you mean '([^']+)'\?")
"""Finds the key that the sentence of `unknown_key` proposes."""

_MOST_PLACES: Final = 3
"""Most places that are named for a key that stands at the wrong one."""


def read_yaml(text: str) -> Any:
    """Return the value of a YAML text.

    Raises
    ------
    yaml.YAMLError
        If it is not YAML, or holds an impossible value.
    """
    root = nodes_of(text)
    try:
        require_sane(root)
    except RecursionError as error:
        raise yaml.YAMLError(str(error)) from error
    return value_of(root)


def nodes_of(text: str) -> yaml.Node | None:
    """Return the nodes of a YAML text, which have line numbers and duplicate keys; None for an empty text.

    Raises
    ------
    yaml.YAMLError
        If it is not YAML.
    """
    try:
        return yaml.compose(text, Loader=yaml.SafeLoader)
    except (ValueError, RecursionError) as error:  # the library's parser leaks these
        raise yaml.YAMLError(f"{type(error).__name__}: {error}") from error


def require_sane(root: yaml.Node | None) -> None:
    """Check that the values of a YAML text can be handled, however they are written.

    Raises
    ------
    RecursionError
        If an alias contains itself.
    yaml.YAMLError
        If there are more than `MOST_NODES` values once aliases are replaced, or a number is too long.
    """
    if root is None:
        return
    if _size(root, {}) > MOST_NODES:
        raise yaml.YAMLError(f"its aliases stand for more than {MOST_NODES:,} values; write them out, or fewer of them")


def _size(node: yaml.Node, known: dict[int, int | None]) -> int:
    """Return the number of values of a node; `known` has those of the nodes before, None for those around it."""
    key = id(node)
    if key in known:
        size = known[key]
        if size is None:
            raise RecursionError("an alias contains itself")
        return size
    known[key] = None
    parts: list[yaml.Node] = []
    if isinstance(node, yaml.MappingNode):
        parts = [part for pair in node.value for part in pair]
    elif isinstance(node, yaml.SequenceNode):
        parts = node.value
    elif node.tag == _INT and len(node.value) > MOST_DIGITS:
        what = f"expected a number of at most {MOST_DIGITS} digits, got one of {len(node.value)}"
        raise yaml.MarkedYAMLError(problem=what, problem_mark=node.start_mark)
    size = known[key] = 1 + sum(_size(part, known) for part in parts)
    return size


def value_of(root: yaml.Node | None) -> Any:
    """Return the value of the nodes of a YAML text; None for an empty text.

    Raises
    ------
    yaml.YAMLError
        If it holds an impossible value such as the 45th of a month.
    """
    loader = yaml.SafeLoader("")
    try:
        return None if root is None else loader.construct_document(root)
    except (ValueError, KeyError, AttributeError, RecursionError) as error:  # the library's constructors leak these
        raise yaml.YAMLError(f"{type(error).__name__}: {error}") from error


class Locator:
    """Turns a place inside a file into "file:line: place".

    Parameters
    ----------
    source : str
        Name of the file.
    root : yaml.Node or None
        The file's YAML nodes.
    """

    def __init__(self, source: str, root: yaml.Node | None) -> None:
        self._source = source
        self._lines = {tuple(map(str, place)): line for place, line in _lines(root)}

    def fault(self, place: Place, what: str) -> Fault:
        """Return a fault with the line of `place`, or of the innermost part of it that the file has."""
        line = self.line(place)
        where = self._source if line is None else f"{self._source}:{line}"
        return Fault(f"{where}: {dotted(place)}" if place else where, what)

    def line(self, place: Place) -> int | None:
        """Return the line of `place`, or of the innermost part of it that the file has; None if it has none."""
        known = tuple(map(str, place))
        while known and known not in self._lines:
            known = known[:-1]
        return self._lines.get(known)


def dotted(place: Place) -> str:
    """Return a place as text, such as `arrays.north.position_m.0`."""
    return ".".join(map(str, place))


def duplicate_keys(node: yaml.Node | None, place: Place = ()) -> Iterator[Finding]:
    """Yield keys that a mapping holds twice."""
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key, value in node.value:
            here = (*place, key.value)
            if key.value in seen:
                yield here, "expected each key once, got it twice; remove one"
            seen.add(key.value)
            yield from duplicate_keys(value, here)


def validation_findings(model: type[BaseModel], errors: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """Return pydantic's errors for a file that `model` describes, each as one sentence."""
    found: list[Finding] = []
    for error in errors:
        place = _place_of(error)
        found.append((place, _unknown_key(model, place) if error["type"] == "extra_forbidden" else _sentence(error)))
    return one_for_each_slip(found, errors)


def one_for_each_slip(findings: Sequence[Finding], errors: Iterable[Mapping[str, Any]]) -> list[Finding]:
    """Leave out that a key is missing where another finding says that it is misspelt; `errors` are pydantic's."""
    missing = {_place_of(error) for error in errors if error["type"] == "missing"}
    misspelt = {(*place[:-1], meant[1]) for place, what in findings if (meant := _MEANT.search(what)) is not None}
    return [finding for finding in findings if finding[0] not in missing & misspelt]


def _place_of(error: Mapping[str, Any]) -> Place:
    return tuple(part for part in error["loc"] if part != "[key]")


def unknown_key(key: str, known: Iterable[str], elsewhere: Iterable[str] = ()) -> str:
    """Return the sentence for a key that is not known, with what was probably meant.

    Parameters
    ----------
    key : str
    known : iterable of str
        Keys that are known at its place.
    elsewhere : iterable of str
        Places at which the very key is known.
    """
    names = list(known)
    stem, _, unit = key.rpartition("_")
    for meant in names if unit in _FOREIGN_UNITS else ():
        if meant.rpartition("_")[0] == stem:
            own, others = _FOREIGN_UNITS[unit]
            if meant.endswith(f"_{own}"):
                return f"unknown key {key!r}; did you mean {meant!r}? Convert its value from {others}"
    places = list(elsewhere)
    if places:
        return f"unknown key {key!r}; it belongs to {' or '.join(places[:_MOST_PLACES])}"
    similar = get_close_matches(key.lower(), names, 1)
    return f"unknown key {key!r}; " + (f"did you mean {similar[0]!r}?" if similar else "remove it")


def places_of(model: type[BaseModel], key: str, place: str = "") -> list[str]:
    """Return the places below a model at which a key is known; NAME stands for the name of an entry."""
    found = [place] if place and key in model.model_fields else []
    for name, field in model.model_fields.items():
        below = f"{place}.{name}" if place else name
        named = get_origin(field.annotation) is dict
        for inner in _models_in(field.annotation):
            found += places_of(inner, key, f"{below}.NAME" if named else below)
    return list(dict.fromkeys(found))


def unknown_array(name: str, known: Iterable[str]) -> str:
    """Return the sentence for an array that the file does not have, with the name that is most like it."""
    names = list(known)
    cure = did_you_mean(name, names) or "; correct the name or add the array"
    return f"expected one of the arrays {', '.join(names)}, got {name!r}{cure}"


def _unknown_key(model: type[BaseModel], place: Place) -> str:
    key = str(place[-1])
    return unknown_key(key, _keys_at(model, place[:-1]), places_of(model, key))


def read_model(model: type[Read], path: Path, what: str) -> Read:
    """Return what a YAML file holds.

    Parameters
    ----------
    model : type
        Model of the file.
    path : Path
    what : str
        Name of such files, for messages.

    Raises
    ------
    ConfigError
        With every fault of the file.
    """
    try:
        return model.model_validate(read_yaml(path.read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError, RecursionError, yaml.YAMLError) as error:
        raise ConfigError([Fault(str(path), f"{what} cannot be read: {reason(error)}")]) from error
    except ValidationError as error:
        findings = validation_findings(model, error.errors())
        where = [f"{path}: {dotted(place)}" if place else str(path) for place, _ in findings]
        faults = [Fault(at, said) for at, (_, said) in zip(where, findings, strict=True)]
        raise ConfigError(faults) from error


def reason(error: Exception) -> str:
    """Return why something could not be read, in one line without its path."""
    if isinstance(error, UnicodeDecodeError):
        return "it is not UTF-8 text; save it as UTF-8"
    return " ".join((getattr(error, "strerror", None) or str(error)).split())


def _sentence(error: Mapping[str, Any]) -> str:
    meant = slip(error)
    if meant is not None:
        return meant
    got = error.get("input")
    template = _SENTENCES.get(error["type"])
    if template is not None:
        text = template.format(**{**error.get("ctx", {}), "got": repr(got)})
        return text.replace("least 1 items", "least 1 item")
    message = str(error["msg"]).removeprefix("Value error, ").replace("Input should be", "expected")
    simple = isinstance(got, str | int | float | bool) or got is None
    return f"{message}, got {got!r}" if simple and "got" not in message else message


def _keys_at(model: type[BaseModel], place: Place) -> list[str]:
    """Return the keys that the models know at a place; parts that are no field are names or indices."""
    models = [model]
    for part in place:
        annotations = [known.model_fields[part].annotation for known in models if part in known.model_fields]
        models = [inner for annotation in annotations for inner in _models_in(annotation)] or models
    return [key for known in models for key in known.model_fields]


def _models_in(annotation: Any) -> Sequence[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models_in(part)]


def _lines(node: yaml.Node | None, place: Place = ()) -> Iterator[tuple[Place, int]]:
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            here = (*place, key.value)
            yield here, key.start_mark.line + 1
            yield from _lines(value, here)
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            yield (*place, index), value.start_mark.line + 1
            yield from _lines(value, (*place, index))
