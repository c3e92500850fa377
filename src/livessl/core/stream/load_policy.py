"""Decides under overload which work is shed and when, by the delay of the sound, and which arrays are still used.

`LEVELS` lists the work that is shed at each level, the least important first. `LoadPolicy` chooses the level by the
delay of the sound, with hysteresis, and reads no clock. `Clearest` chooses the arrays that are used when arrays are
shed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

INTERVAL_NS: Final = 1_000_000_000
"""Interval, in nanoseconds, whose smallest delay decides. A queue that empties within the interval is no overload,
whatever its peaks (Nichols and Jacobson 2012, "Controlling queue delay"). With half a second, locating a single event
on a busy machine counted as overload."""

BEHIND_S: Final = 0.1
"""Smallest delay of an interval, in seconds, from which the level rises by one: a fifth of the 0.5 s that live results
may take."""

MIN_MEASUREMENTS: Final = 3
"""Fewest measurements in an interval; one slow fusion step, such as when a node joins, is no overload."""

FAR_BEHIND_S: Final = 0.3
"""Smallest delay of an interval, in seconds, from which the level rises by two."""

CALM_S: Final = 0.05
"""Smallest delay of an interval, in seconds, up to which the interval is calm: one frame. In a calm interval the queue
has emptied."""

IDLE: Final = 0.5
"""Share of the time, 0 to 1, in which the fusion computes; below this share the load has ended, and `IDLE_HOLD_NS` of
calm lowers the level."""

IDLE_HOLD_NS: Final = 1_000_000_000
"""Length of the calm, in nanoseconds, that lowers the level by one while the fusion is idle."""

HOLD_NS: Final = 3_000_000_000
"""Length of the calm, in nanoseconds, that lowers the level by one while the fusion is busy. It is doubled when the
level was lowered too soon (`RELAPSE_NS`)."""

RELAPSE_NS: Final = 15_000_000_000
"""Time after the level was lowered, in nanoseconds. If the level has to rise again within this time, it was lowered too
soon."""

LONGEST_HOLD_NS: Final = 40_000_000_000
"""Longest value, in nanoseconds, to which the length of the calm is doubled."""

PROMPT_S: Final = 0.25
"""Delay, in seconds, beyond which every level that sheds updates sheds all updates and second looks. It is half of the
time that live results may take; the other half is needed for locating and delivering."""


@dataclass(frozen=True, slots=True)
class Relief:
    """The work that is done, and that is shed, at one level.

    Parameters
    ----------
    update_every : int or None
        Every `update_every`-th update is located; None locates no updates.
    second_looks : bool
        Whether the estimator may locate an unsure event a second time, from other evidence.
    maps : bool
        Whether power maps are drawn.
    arrays : int or None
        Largest number of arrays from which an event or an update is located; None for the number that the estimator
        uses by itself. The other arrays still count for the activity, and events still list them as having detected
        the sound.
    ahead : bool
        Whether quiet frames are correlated before it is known that sound follows.
    """

    update_every: int | None = 1
    second_looks: bool = True
    maps: bool = True
    arrays: int | None = None
    ahead: bool = True

    @property
    def shed(self) -> tuple[str, ...]:
        """The work that is shed, by the names that the API uses."""
        which = {
            "updates": self.update_every != 1,
            "second_looks": not self.second_looks,
            "maps": not self.maps,
            "arrays": self.arrays is not None,
            "quiet": not self.ahead,
        }
        return tuple(name for name, is_shed in which.items() if is_shed)


NOTHING_SHED: Final = Relief()

LEVELS: Final = (
    NOTHING_SHED,
    Relief(update_every=2),
    Relief(update_every=5, second_looks=False),
    Relief(update_every=5, second_looks=False, maps=False),
    Relief(update_every=5, second_looks=False, maps=False, arrays=32),
    Relief(update_every=5, second_looks=False, maps=False, arrays=16),
    Relief(update_every=10, second_looks=False, maps=False, arrays=8),
    Relief(update_every=10, second_looks=False, maps=False, arrays=4),
    Relief(update_every=10, second_looks=False, maps=False, arrays=4, ahead=False),
    Relief(update_every=None, second_looks=False, maps=False, arrays=3, ahead=False),
)
"""The work that is shed at each level: first updates, then second looks at unsure events, maps, the arrays with the
least power above their noise floor, and last the correlation of quiet frames. With the defaults, an update every 0.1 s
becomes one every 0.2 s, 0.5 s and 1 s."""


class LoadPolicy:
    """Chooses the level of shedding by the delay of the sound.

    Parameters
    ----------
    levels : int
        Number of levels.
    """

    def __init__(self, levels: int = len(LEVELS)) -> None:
        self.level = 0
        """The level that applies now."""
        self._highest = levels - 1
        self._least_s: float | None = None  # smallest delay in the interval
        self._measurements = 0  # number of measurements in the interval
        self._began_ns: int | None = None  # begin of the interval
        self._calm_ns: int | None = None  # begin of the calm; None while the queue does not empty
        self._lowered_ns: int | None = None  # time at which the level was lowered last
        self._hold_ns = HOLD_NS

    def note(self, delay_s: float, busy: float, now_ns: int) -> int:
        """Take in a measurement and return the level that applies.

        Parameters
        ----------
        delay_s : float
            Time, in seconds, for which the next message has waited; 0 if no message waits.
        busy : float
            Share of the time in which the fusion computes, 0 to 1.
        now_ns : int
            Time of a monotonic clock, nanoseconds.
        """
        if self._began_ns is None:
            self._began_ns = now_ns
        self._least_s = delay_s if self._least_s is None else min(self._least_s, delay_s)
        self._measurements += 1
        if now_ns - self._began_ns >= INTERVAL_NS and self._measurements >= MIN_MEASUREMENTS:
            least_s, self._least_s, self._began_ns, self._measurements = self._least_s, None, now_ns, 0
            self._judge(least_s, busy, now_ns)
        return self.level

    def _judge(self, least_s: float, busy: float, now_ns: int) -> None:
        if least_s >= BEHIND_S:
            if self._lowered_ns is not None and now_ns - self._lowered_ns < RELAPSE_NS:
                self._hold_ns = min(2 * self._hold_ns, LONGEST_HOLD_NS)
            self._lowered_ns = self._calm_ns = None
            self.level = min(self._highest, self.level + (2 if least_s >= FAR_BEHIND_S else 1))
        elif least_s > CALM_S or self.level == 0:
            self._calm_ns = None
        elif self._calm_ns is None:
            self._calm_ns = now_ns
        elif now_ns - self._calm_ns >= (IDLE_HOLD_NS if busy < IDLE else self._hold_ns):
            self.level -= 1
            self._lowered_ns, self._calm_ns = now_ns, now_ns
        if self.level == 0 and self._lowered_ns is not None and now_ns - self._lowered_ns >= RELAPSE_NS:
            self._lowered_ns, self._hold_ns = None, HOLD_NS


JOIN_FACTOR: Final = 4.0
"""Ratio of power above background at and above which an array replaces the chosen array with the smallest ratio to its
background: 6 dB, so that the choice does not change with every frame."""


class Clearest:
    """Chooses the clearest arrays of an event: those with the highest power relative to their own background.

    The power is in the header of each frame, so choosing needs no samples. Among the chosen arrays, the estimator then
    ranks by onset strength, which takes reverberation into account (`livessl.core.locate.estimator`).
    """

    def __init__(self) -> None:
        self._background: dict[str, float] = {}
        self._power: dict[str, float] = {}
        self._chosen: set[str] = set()

    @property
    def chosen(self) -> frozenset[str]:
        """Names of the arrays that are chosen."""
        return frozenset(self._chosen)

    def note(self, array: str, power: float, *, active: bool) -> None:
        """Take in a frame of an array: its power, full scale squared, and whether it is active."""
        if active:
            self._power[array] = max(power, self._power.get(array, 0.0))
        else:
            self._background[array] = min(power, self._background.get(array, power))

    def choose(self, most: int) -> list[str]:
        """Choose up to `most` active arrays; return those that were not chosen before.

        A chosen array stays chosen unless the ratio of another one is larger by `JOIN_FACTOR`.
        """
        ratios = self._power_ratios()
        for name in sorted(self._chosen, key=lambda name: ratios[name])[: max(0, len(self._chosen) - most)]:
            self._chosen.discard(name)
        joined: list[str] = []
        for name in sorted(ratios.keys() - self._chosen, key=lambda name: (-ratios[name], name)):
            if len(self._chosen) >= most:
                least = min(self._chosen, key=lambda name: ratios[name])
                if ratios[name] < JOIN_FACTOR * ratios[least]:
                    break
                self._chosen.discard(least)
            self._chosen.add(name)
            joined.append(name)
        return [name for name in joined if name in self._chosen]

    def _power_ratios(self) -> Mapping[str, float]:
        """Return the ratio of power to background of each active array; at least 1."""
        typical = _median(self._background.values())
        return {
            name: max(1.0, power / max(self._background.get(name, typical), 1e-30))
            for name, power in self._power.items()
        }


def _median(values: Iterable[float]) -> float:
    """Return the upper median; 0 without values, so that the array with the highest power is the clearest."""
    ascending = sorted(values)
    return ascending[len(ascending) // 2] if ascending else 0.0
