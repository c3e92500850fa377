"""Any data, value or text is a usable site or a clear error."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from livessl.errors import ConfigError
from livessl.site.build.grid import search_grid
from livessl.site.build.pipeline import activity_parameters
from livessl.site.load import parse_site
from livessl.site.models import Site
from site_faults import JOINT
from small_site import small

SCALARS = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.dates()
    | st.binary(max_size=4)
    | st.sampled_from([0, -1, 1e-320, 1e308, 10**400, "tcp://x:1", "wav", "scene", "\ud800"])
)
DATA = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(SCALARS, inner, max_size=4),
    max_leaves=8,
)


def places(data: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [path] if path else []
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        found += places(value, (*path, key))
    return found


WHOLE = small(
    {
        "temperature_c": 20.0,
        "activity": {"threshold": 0.1, "floor_factor": 4.0, "min_level_dbfs": -90.0},
        "fusion": {"method": "srp-phat", "min_arrays": 1},
        "grid": {"spacing_m": 0.5, "bounds_m": [[0, 4], [0, 5], [0, 3]]},
        "arrays.north.orientation_deg": {"yaw": 10.0},
        "arrays.west": {"microphones_m": [[1, 1, 1], [1, 2, 1]], "band_hz": [100, 5000]},
        "nodes.player": {"device": {"type": "scene", "rt60_s": 0.3}, "arrays": {"west": [1, 2]}},
        JOINT: ["north", "south"],
    }
)


@given(DATA)
@settings(max_examples=100, deadline=None)
def test_any_data_is_a_site_or_a_config_error(data: Any) -> None:
    with suppress(ConfigError):
        parse_site(yaml.safe_dump(data, allow_unicode=False))


@given(st.sampled_from(places(WHOLE)), DATA, st.sampled_from(places(WHOLE)), SCALARS)
@settings(max_examples=120, suppress_health_check=[HealthCheck.too_slow], deadline=None)
def test_any_value_anywhere_is_fine_or_a_config_error(
    place: tuple[Any, ...], value: Any, other: tuple[Any, ...], scalar: Any
) -> None:
    data = yaml.safe_load(yaml.safe_dump(WHOLE))
    for path, new in ((place, value), (other, scalar)):
        holder = data
        with suppress(KeyError, IndexError, TypeError):  # the first change may have removed the second's place
            for key in path[:-1]:
                holder = holder[key]
            holder[path[-1]] = new
    with suppress(ConfigError):
        assert_usable(parse_site(yaml.safe_dump(data)))


@given(st.text())
@settings(deadline=None)
def test_any_text_is_a_site_or_a_config_error(text: str) -> None:
    with suppress(ConfigError):
        parse_site(text)


def assert_usable(site: Site) -> None:
    assert search_grid(site).size > 0
    assert activity_parameters(site).min_power >= 0
    assert site.c_m_s > 0
    assert len(site.specs) == len(site.arrays)
    assert {name for spec in site.processed for name in site.members(spec.name)} == set(site.arrays)
