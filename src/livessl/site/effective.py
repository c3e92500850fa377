"""Lists every setting in effect with the origin of its value: file, default or calibration (`livessl config show`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import yaml

from livessl.site.calibration_file import read_calibration
from livessl.site.findings import Locator, dotted, nodes_of, value_of
from livessl.site.load import load_site
from livessl.site.models import Site
from livessl.site.place import Place
from livessl.site.slips import quote_keys

DEFAULT: Final = "default"
"""Source of a value that is not in the site file."""

_POSE: Final = frozenset(("microphones_m", "geometry", "position_m", "orientation_deg"))
_SHAPES: Final = frozenset(("tetrahedron", "circle", "line"))


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting.

    Parameters
    ----------
    place : tuple
        Keys of the setting, from the top of the file.
    value : Any
        Value of a type that JSON has; None for a setting that is not used.
    source : str
        Source of the value: "FILE:LINE", or words such as "default".
    line : int or None
        Line of the site file; None if the value is not in the file.
    """

    place: Place
    value: Any
    source: str
    line: int | None

    @property
    def key(self) -> str:
        """The place as text, such as `grid.spacing_m`."""
        return dotted(self.place)

    @property
    def is_used(self) -> bool:
        """False for a setting that is off, and for one whose value another setting determines."""
        return self.value is not None and not self.source.startswith(("the site's", "from "))


def effective_settings(path: Path) -> list[Setting]:
    """Return every setting of a site file, in the order of the reference.

    Raises
    ------
    ConfigError
        If the site file has faults; the error lists all of them.
    """
    site = load_site(path)
    root = nodes_of(path.read_text(encoding="utf-8"))
    list(quote_keys(root))
    given, locator, measured = value_of(root), Locator(str(path), root), _measured(site)
    settings = []
    for place, value in _leaves(site.model_dump(mode="json")):
        line = locator.line(place) if _is_in(given, place) else None
        source = f"{path}:{line}" if line is not None else DEFAULT
        if place == ("speed_of_sound_m_s",) and line is None:
            value, source = site.c_m_s, DEFAULT if site.temperature_c is None else "from temperature_c"
        if place[0] == "arrays" and place[1] in measured and set(place) & _POSE:
            source += f", replaced by {site.calibration}"
        settings.append(Setting(place, value, source, line))
    in_effect = [setting for setting in settings if not _is_unused(setting)]
    return [_calibrated(setting, site, measured) or _inherited(setting, settings) for setting in in_effect]


def _measured(site: Site) -> set[str]:
    """Return the names of the arrays whose microphones are in the calibration file."""
    return set() if site.calibration is None else set(read_calibration(site.file(site.calibration)).arrays)


def _calibrated(setting: Setting, site: Site, measured: set[str]) -> Setting | None:
    """Return an array's setting of `uncertainty` with the calibration file's value; None for any other setting."""
    section, array, group, key = (*setting.place, "", "", "", "")[:4]
    if section != "arrays" or array not in measured or group != "uncertainty" or setting.line is not None:
        return None
    if key not in ("", "position_m", "orientation_deg"):
        return None
    value = getattr(site.array(array).uncertainty, key) if key else None
    return Setting(
        setting.place, value, f"from {site.calibration}" if key else f"from {site.calibration}, and the site's", None
    )


def _inherited(setting: Setting, settings: list[Setting]) -> Setting:
    """Return an array's setting with the value of the whole site if the file does not set it; otherwise unchanged."""
    above = setting.place[2:] if setting.place[0] == "arrays" else ()
    if setting.line is not None or above[:1] not in (("band_hz",), ("uncertainty",)):
        return setting
    for other in settings:
        if other.place == above:
            return Setting(setting.place, other.value, f"the site's, {other.source}", None)
    return Setting(setting.place, None, "the site's", None)


def _is_unused(setting: Setting) -> bool:
    """Return True for a setting of a form or shape that the array does not have, such as the edge of a circle."""
    return setting.value is None and setting.place[0] == "arrays" and setting.place[-1] in _POSE | _SHAPES


def _leaves(value: Any, place: Place = ()) -> Iterator[tuple[Place, Any]]:
    """Yield every value that is not a mapping, and every empty mapping."""
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from _leaves(inner, (*place, key))
    else:
        yield place, value


def _is_in(data: Any, place: Place) -> bool:
    for key in place:
        if not isinstance(data, Mapping) or key not in data:
            return False
        data = data[key]
    return True


def as_yaml(settings: list[Setting], width: int = 48) -> str:
    """Return the settings as a site file, each with its source as a comment; unused settings are commented out."""
    used = {one.place[:depth] for one in settings if one.is_used for depth in range(len(one.place) + 1)}
    lines: list[str] = []
    before: Place = ()
    for setting in settings:
        *parents, key = setting.place
        for depth, name in enumerate(parents):
            place = setting.place[: depth + 1]
            if place != before[: depth + 1]:
                lines.append(f"{'  ' * depth}{'' if place in used else '# '}{_yaml(name)}:")
        before = setting.place
        text = f"{'  ' * len(parents)}{'' if setting.is_used else '# '}{_yaml(key)}: {_yaml(setting.value)}"
        lines.append(f"{text:<{width}}  # {setting.source}")
    return "\n".join(lines) + "\n"


def _yaml(value: Any) -> str:
    """Return a value as YAML on one line."""
    text: str = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True, width=10**6, sort_keys=False)
    return text.removesuffix("...\n").strip()
