"""Keeps the latest sounds, each with the delays that every array observed between its microphones.

Measuring the poses of the arrays, and finding faults of the set-up, begins with these delays.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, replace
from typing import Final

from livessl.core.commission.observe import observe
from livessl.core.types import Event, Observation

KEPT: Final = 64
"""Number of sounds that are kept. A guided calibration ends after 12 claps; one with given places may have 64. A
calibration by sounds at unknown places uses 20 by default."""


@dataclass(frozen=True, slots=True)
class HeardSound:
    """One sound, and the observations of the arrays.

    Parameters
    ----------
    number : int
        Number of the sound; later sounds have higher ones.
    event : Event
        Final event of the sound. `received`, the sound itself, is left out.
    observations : tuple of Observation
        What each array observed: the delays between its microphones.
    """

    number: int
    event: Event
    observations: tuple[Observation, ...]


class HeardSounds:
    """Keeps the last sounds. The fusion thread calls `take` and `forget`; every thread may read.

    Delays are measured when they are read, so that they take no time of the fusion thread.

    Parameters
    ----------
    first : int
        The first sound has the number `first` + 1. The numbers of a later run of the server begin above those of an
        earlier one, so that a client does not confuse them.
    """

    def __init__(self, first: int = 0) -> None:
        self._lock = threading.Lock()
        self._observing = threading.Lock()
        self._new: deque[tuple[int, Event]] = deque(maxlen=KEPT)
        self._sounds: deque[HeardSound] = deque(maxlen=KEPT)
        self._last = first
        self._observed = first  # number of the last sound whose delays were measured
        self._generation = 0  # increased when all sounds are forgotten

    @property
    def last(self) -> int:
        """Number of the last sound; before the first sound, the number `first`."""
        return self._last

    def take(self, event: Event) -> None:
        """Take in a final event, with the sound that the arrays received."""
        with self._lock:
            self._last += 1
            self._new.append((self._last, event))

    def forget(self) -> None:
        """Forget all sounds; numbers continue."""
        with self._lock:
            self._new.clear()
            self._sounds.clear()
            self._generation += 1

    def after(self, number: int) -> list[HeardSound]:
        """Return the sounds with a higher number, the oldest first."""
        return self.read(number)[0]

    def read(self, number: int) -> tuple[list[HeardSound], int]:
        """Return the sounds with a higher number, the oldest first, and the `number` for the next request."""
        self._observe()
        with self._lock:
            return [sound for sound in self._sounds if sound.number > number], self._observed

    def numbered(self, numbers: list[int]) -> list[HeardSound]:
        """Return the sounds of these numbers in this order.

        Raises
        ------
        LookupError
            If a sound is not kept any more; the error contains the first such number.
        """
        known = {sound.number: sound for sound in self.after(0)}
        missing = next((number for number in numbers if number not in known), None)
        if missing is not None:
            raise LookupError(missing)
        return [known[number] for number in numbers]

    def _observe(self) -> None:
        """Measure the delays of new sounds."""
        with self._observing:
            with self._lock:
                new, generation, last = list(self._new), self._generation, self._last
                self._new.clear()
                if not new:
                    self._observed = last
                    return
            observed = [
                HeardSound(number, replace(event, received=()), observe(event.received)) for number, event in new
            ]
            with self._lock:
                self._observed = last
                if generation == self._generation:  # otherwise they were forgotten meanwhile
                    self._sounds.extend(observed)
