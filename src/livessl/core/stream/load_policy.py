"""Work that is shed while the sound arrives faster than it can be located: a table of levels, and which one applies.

It reads no clock. `LEVELS` is the order in which work is given up, the least missed first. `LoadPolicy` moves along the
table by the delay of the sound, with hysteresis.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

INTERVAL_NS: Final = 1_000_000_000
"""Time, in nanoseconds, of which the least delay is judged. A delay that never falls in that time is a queue that does
not empty; the peaks of a queue that does are no overload (Nichols and Jacobson 2012, "Controlling queue delay"). With
half a second the location of an event, on a busy machine, counted as overload."""

BEHIND_S: Final = 0.1
"""Least delay, in seconds, at and above which more is shed: a fifth of the 0.5 s that live results may take."""

TURNS: Final = 3
"""Fewest measurements from which more is shed: a single long turn, as when nodes join, is no overload."""

FAR_BEHIND_S: Final = 0.3
"""Least delay, in seconds, from which on two levels are taken at once."""

CALM_S: Final = 0.05
"""Least delay, in seconds, up to which the queue empties: one frame."""

IDLE: Final = 0.5
"""Share of the time that the fusion works, below which less is shed after `IDLE_HOLD_NS`: the load has ended."""

IDLE_HOLD_NS: Final = 1_000_000_000
"""Calm, in nanoseconds, after which less is shed if the fusion is idle."""

HOLD_NS: Final = 3_000_000_000
"""Calm, in nanoseconds, after which less is shed if the fusion is busy. A level that turned out to be needed is held
twice as long the next time."""

RELAPSE_NS: Final = 15_000_000_000
"""Time, in nanoseconds: if more has to be shed again within it, less was shed too soon."""

LONGEST_HOLD_NS: Final = 40_000_000_000
"""Longest hold, in nanoseconds."""

PROMPT_S: Final = 0.25
"""Delay, in seconds, beyond which a level that sheds updates leaves them all out, and second looks as well: half of the
time that live results may take. The other half is needed to locate and to deliver."""


@dataclass(frozen=True, slots=True)
class Relief:
    """The work that is shed.

    Parameters
    ----------
    update_every : int or None
        One of so many updates is located; None locates none.
    second_looks : bool
        Whether the estimator may take further looks at a doubtful sound.
    maps : bool
        Whether power maps are drawn.
    arrays : int or None
        Most arrays from whose sound an event or an update is located; None for as many as the estimator takes. Further
        arrays still take part in the activity, and events still name them as having detected the sound.
    ahead : bool
        Whether frames of quiet are correlated before it is known that sound follows.
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
"""The work that is shed at each level: updates first, then second looks at doubtful sounds, then maps, then arrays of
little evidence, then frames of quiet. With the defaults an update every 0.1 s becomes one every 0.2, 0.5 and 1 s."""


class LoadPolicy:
    """The level of shedding, by the delay of the sound.

    Parameters
    ----------
    levels : int
        Number of levels.
    """

    def __init__(self, levels: int = len(LEVELS)) -> None:
        self.level = 0
        """The level that applies now."""
        self._highest = levels - 1
        self._least_s: float | None = None  # least delay of the interval
        self._turns = 0  # measurements in the interval
        self._began_ns: int | None = None  # when the interval began
        self._calm_ns: int | None = None  # since when the queue has emptied in every interval
        self._eased_ns: int | None = None  # when less was shed last
        self._hold_ns = HOLD_NS

    def note(self, delay_s: float, busy: float, now_ns: int) -> int:
        """Take in a measurement and return the level that applies.

        Parameters
        ----------
        delay_s : float
            How long ago the sound arrived that is processed next; 0 if there is none.
        busy : float
            Share of the time that the fusion works, 0 to 1.
        now_ns : int
            By a monotonic clock.
        """
        if self._began_ns is None:
            self._began_ns = now_ns
        self._least_s = delay_s if self._least_s is None else min(self._least_s, delay_s)
        self._turns += 1
        if now_ns - self._began_ns >= INTERVAL_NS and self._turns >= TURNS:
            least_s, self._least_s, self._began_ns, self._turns = self._least_s, None, now_ns, 0
            self._judge(least_s, busy, now_ns)
        return self.level

    def _judge(self, least_s: float, busy: float, now_ns: int) -> None:
        if least_s >= BEHIND_S:
            if self._eased_ns is not None and now_ns - self._eased_ns < RELAPSE_NS:
                self._hold_ns = min(2 * self._hold_ns, LONGEST_HOLD_NS)
            self._eased_ns = self._calm_ns = None
            self.level = min(self._highest, self.level + (2 if least_s >= FAR_BEHIND_S else 1))
        elif least_s > CALM_S or self.level == 0:
            self._calm_ns = None
        elif self._calm_ns is None:
            self._calm_ns = now_ns
        elif now_ns - self._calm_ns >= (IDLE_HOLD_NS if busy < IDLE else self._hold_ns):
            self.level -= 1
            self._eased_ns, self._calm_ns = now_ns, now_ns
        if self.level == 0 and self._eased_ns is not None and now_ns - self._eased_ns >= RELAPSE_NS:
            self._eased_ns, self._hold_ns = None, HOLD_NS


JOIN_FACTOR: Final = 4.0
"""Ratio of an array's clarity to that of the least clear chosen one at and above which it takes its place: 6 dB, so
that the choice does not change with every frame."""


class Clearest:
    """The arrays to which an event is clearest: those with the most power above their own background.

    What it needs of a frame is in its header, so that choosing costs nothing. The ranking by onset strength, which also
    knows reverberation, is applied afterwards to those that were chosen (`livessl.core.locate.estimator`).
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
        """Choose up to `most` arrays that are active; return those that were not chosen before.

        A chosen array keeps its place unless another one is clearer by `JOIN_FACTOR`.
        """
        clarity = self._clarity()
        for name in sorted(self._chosen, key=lambda name: clarity[name])[: max(0, len(self._chosen) - most)]:
            self._chosen.discard(name)
        joined: list[str] = []
        for name in sorted(clarity.keys() - self._chosen, key=lambda name: (-clarity[name], name)):
            if len(self._chosen) >= most:
                least = min(self._chosen, key=lambda name: clarity[name])
                if clarity[name] < JOIN_FACTOR * clarity[least]:
                    break
                self._chosen.discard(least)
            self._chosen.add(name)
            joined.append(name)
        return [name for name in joined if name in self._chosen]

    def _clarity(self) -> Mapping[str, float]:
        """Return the ratio of power to background of each active array; 1 at least."""
        typical = _median(self._background.values())
        return {
            name: max(1.0, power / max(self._background.get(name, typical), 1e-30))
            for name, power in self._power.items()
        }


def _median(values: Iterable[float]) -> float:
    """Return the upper median; 0 of nothing, with which the most powerful array is the clearest."""
    ascending = sorted(values)
    return ascending[len(ascending) // 2] if ascending else 0.0
