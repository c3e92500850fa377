"""The registry of methods, and a method of one's own in a dozen lines, used by fusion like a built-in one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np
import pytest

from free_field import C_M_S, RATE_HZ, burst, heard, tetra
from livessl.core.geometry import Grid
from livessl.core.locate.estimator import Localization, Sound, create, register
from livessl.core.locate.map_estimator import MapEstimator
from livessl.core.locate.srp_phat import SrpPhat
from livessl.core.methods import METHODS
from livessl.core.stream.fusion import Fusion
from livessl.core.stream.site_state import SiteState
from livessl.core.types import FRAME_NS, Event, Frame, Mark, Message, Update, Window

GRID = Grid(((0.0, 4.2), (0.0, 5.1), (0.0, 2.7)), 0.1)
ARRAYS = [tetra("north", [2.7, 4.2, 1.3]), tetra("south", [2.3, 1.1, 1.5], yaw_deg=71.0)]
SOURCE_M = np.array([1.13, 3.31, 1.47])
HALF_CELL_DIAGONAL_M = 0.5 * np.sqrt(3.0) * 0.1


class HighestGridPoint(MapEstimator):
    """The smallest method: the highest point of the summed GCC-PHAT maps."""

    def locate(self, sounds: Mapping[str, Sound]) -> Localization:
        evidence = self.evidence(sounds)
        maps = self.power_maps(evidence)
        position_m = maps.grid.point_m(int(maps.fused.argmax()))
        return Localization(position_m, np.diag(maps.grid.cell_m**2), 0.5, evidence)


@pytest.fixture
def registered() -> Iterator[str]:
    register("highest-grid-point", HighestGridPoint)
    yield "highest-grid-point"
    del METHODS["highest-grid-point"]


def messages() -> list[Message]:
    """Twelve frames of sound at both arrays, and then silence."""
    sound = burst(12 * 800)
    out: list[Message] = []
    for spec in ARRAYS:
        for k, samples in enumerate(np.split(heard(spec, SOURCE_M, sound), 12, axis=1)):
            power = float(np.square(samples).mean())
            out.append(Frame(spec.name, k + 1, k, k * FRAME_NS, RATE_HZ, samples.copy(), power, active=True))
        out += [Mark(spec.name, k, 12, 0.0, 0.0, (0.0,) * 4) for k in range(12, 24)]
    return out


def test_every_built_in_method_makes_an_estimator_of_its_name() -> None:
    for name in ("onset", "srp-phat", "cepstral", "averaged"):
        assert create(name, ARRAYS, GRID, C_M_S).name == name
    made = create("srp-phat", ARRAYS, GRID, C_M_S)
    assert type(made) is SrpPhat
    assert SrpPhat(ARRAYS, GRID, C_M_S).name == "srp-phat"


def test_a_minimal_method_locates_windows_and_events_through_fusion(registered: str) -> None:
    fusion = Fusion(SiteState("lab", ARRAYS, create(registered, ARRAYS, GRID, C_M_S)))
    for spec in ARRAYS:
        fusion.prepare(spec.name, RATE_HZ)
    outputs = fusion.step(messages(), 24 * FRAME_NS) + fusion.flush(24 * FRAME_NS)
    (event,) = (output for output in outputs if isinstance(output, Event))
    assert event.method == registered
    updates = [output for output in outputs if isinstance(output, Update)]
    assert updates
    answers: list[Event | Update] = [event, *updates]
    for found in answers:
        assert found.estimate is not None
        # the nearest grid point, or its neighbour: half a cell along one axis may cost less power than along another
        assert np.linalg.norm(found.estimate.position_m - SOURCE_M) < 2 * HALF_CELL_DIAGONAL_M
    window = next(output for output in outputs if isinstance(output, Window))
    assert fusion.power_maps(window, ["south"]).arrays.keys() == {"south"}


def test_an_estimator_carries_the_name_under_which_it_was_registered() -> None:
    register("srp-phat-limited", partial(SrpPhat, band_limit=True))
    assert create("srp-phat-limited", ARRAYS, GRID, C_M_S).name == "srp-phat-limited"
    del METHODS["srp-phat-limited"]


def test_an_unknown_method_is_an_error_with_the_known_ones_and_a_guess(registered: str) -> None:
    message = rf"expected one of onset, .*, {registered}, got 'srp-fat'; did you mean 'srp-phat'\?"
    with pytest.raises(ValueError, match=message):
        create("srp-fat", ARRAYS, GRID, C_M_S)
    with pytest.raises(ValueError, match=r"got 'music'; write a method of your own as MODULE:NAME$"):
        create("music", ARRAYS, GRID, C_M_S)


def test_registering_an_instance_or_an_empty_name_is_an_error() -> None:
    with pytest.raises(TypeError, match=r"method 'mine': expected a factory .* got HighestGridPoint; pass the class"):
        register("mine", HighestGridPoint(ARRAYS, GRID, C_M_S))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="expected a name"):
        register("", HighestGridPoint)
