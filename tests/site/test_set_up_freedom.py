"""How far the doctor lets an array be from its place follows what the site file says of its uncertainty."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from livessl.core.commission.set_up import ORIENTATION_STD_DEG, POSITION_STD_M
from livessl.core.geometry import posed, tetrahedron
from livessl.site.build.set_up import LEAST_ORIENTATION_STD_DEG, LEAST_POSITION_STD_M, freedom_of
from livessl.site.load import parse_site
from livessl.site.models import Site


def site(**of_north: Any) -> Site:
    shape = {
        name: posed(tetrahedron(0.5), (2.0, y_m, 1.5), yaw_deg=0.0).tolist()
        for name, y_m in (("north", 2.0), ("south", 6.0))
    }
    arrays: dict[str, Any] = {name: {"microphones_m": at_m} for name, at_m in shape.items()}
    if of_north:
        arrays["north"]["uncertainty"] = of_north
    return parse_site(json.dumps({"site": "freedom", "room": {"size_m": [5.0, 8.0, 3.0]}, "arrays": arrays}))


def test_a_set_up_of_which_nothing_is_said_is_a_careful_one() -> None:
    for own in freedom_of(site()).values():
        assert own.position_m == pytest.approx(POSITION_STD_M)
        assert own.orientation_deg == pytest.approx(ORIENTATION_STD_DEG)


@given(position_m=st.floats(0.0, 0.5), orientation_deg=st.floats(0.0, 30.0))
def test_the_freedom_of_one_array_grows_with_its_uncertainty_and_has_a_floor(
    position_m: float, orientation_deg: float
) -> None:
    freedom = freedom_of(site(position_m=position_m, orientation_deg=orientation_deg))
    assert freedom["north"].position_m == pytest.approx(max(LEAST_POSITION_STD_M, POSITION_STD_M * position_m / 0.02))
    turn_deg = max(LEAST_ORIENTATION_STD_DEG, ORIENTATION_STD_DEG * orientation_deg / 1.5)
    assert freedom["north"].orientation_deg == pytest.approx(turn_deg)
    assert freedom["south"].orientation_deg == pytest.approx(ORIENTATION_STD_DEG)
