"""Locate sounds in a room, live, with a few small microphone arrays set far apart.

`livessl.locate("site.yaml", {"north": "north.wav", "south": "south.wav"})` returns the events in recordings. Each name
below is loaded when it is first used, so that `import livessl` takes no time.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from livessl.core.commission.finding import Finding
    from livessl.core.geometry import Grid
    from livessl.core.locate.estimator import Estimator, Localization, Sound, register
    from livessl.core.locate.map_estimator import MapEstimator
    from livessl.core.methods import METHODS
    from livessl.core.types import ArraySpec, Estimate, Event
    from livessl.errors import ConfigError
    from livessl.examination import Examination, examine
    from livessl.offline import PowerMap, locate, power_map
    from livessl.simulation.of_site import Simulation, simulate
    from livessl.site.load import load_site
    from livessl.site.models import Site

__version__ = "0.3.0.dev0"

__all__ = [
    "METHODS",
    "ArraySpec",
    "ConfigError",
    "Estimate",
    "Estimator",
    "Event",
    "Examination",
    "Finding",
    "Grid",
    "Localization",
    "MapEstimator",
    "PowerMap",
    "Simulation",
    "Site",
    "Sound",
    "__version__",
    "examine",
    "load_site",
    "locate",
    "power_map",
    "register",
    "simulate",
]

_HOMES: Final = {
    "METHODS": "core.methods",
    "ArraySpec": "core.types",
    "ConfigError": "errors",
    "Estimate": "core.types",
    "Estimator": "core.locate.estimator",
    "Event": "core.types",
    "Examination": "examination",
    "Finding": "core.commission.finding",
    "Grid": "core.geometry",
    "Localization": "core.locate.estimator",
    "MapEstimator": "core.locate.map_estimator",
    "PowerMap": "offline",
    "Simulation": "simulation.of_site",
    "Site": "site.models",
    "Sound": "core.locate.estimator",
    "examine": "examination",
    "load_site": "site.load",
    "locate": "offline",
    "power_map": "offline",
    "register": "core.locate.estimator",
    "simulate": "simulation.of_site",
}
"""The module of each name, below `livessl`."""


def __getattr__(name: str) -> Any:
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module 'livessl' has no attribute {name!r}")
    value = getattr(import_module(f"livessl.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
