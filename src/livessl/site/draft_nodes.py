"""Deals arrays to interfaces and inputs for a first site file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from livessl.errors import ConfigError, Fault
from livessl.site.draft_parts import DraftArray, DraftNode
from livessl.site.interfaces import known_interface

UNKNOWN_RATE_HZ: Final = 48000.0
"""Sampling rate, in hertz, of an interface that is not known: nearly all offer it."""


@dataclass
class _Place:
    """An interface with the inputs that are still free; `free` is None where their number is not known."""

    interface: str
    free: list[int] | None
    next_input: int = 1
    channels: dict[str, tuple[int, ...]] = field(default_factory=dict)

    def take(self, count: int, wanted: Sequence[int] | None = None) -> tuple[int, ...] | None:
        """Return the wanted inputs, or else the next ones, and use them up; None if there are too few."""
        if wanted is not None:
            self.free = None if self.free is None else [number for number in self.free if number not in wanted]
            self.next_input = max(self.next_input, *(number + 1 for number in wanted))
            return tuple(wanted)
        if self.free is None:
            first, self.next_input = self.next_input, self.next_input + count
            return tuple(range(first, first + count))
        if len(self.free) < count:
            return None
        taken, self.free = self.free[:count], self.free[count:]
        return tuple(taken)


def nodes_of(
    arrays: Sequence[DraftArray],
    interfaces: Sequence[str],
    connected: Mapping[str, int],
    rate_hz: float | None = None,
    channels: Mapping[str, Sequence[int]] | None = None,
) -> tuple[DraftNode, ...]:
    """Return a node for each interface, with the arrays dealt out in order.

    Several interfaces get about as many arrays each. An array that does not fit on an interface goes to the next one,
    and beyond the last to another one like it.

    Parameters
    ----------
    arrays : sequence of DraftArray
    interfaces : sequence of str
        Names of the interfaces, or parts of them.
    connected : mapping of str to int
        Number of inputs of the interfaces that are connected to this machine, for those that are not known.
    rate_hz : float or None
        Sampling rate; None for each interface's own.
    channels : mapping of str to sequence of int, or None
        Inputs of some arrays, where the next free ones are not wanted.

    Raises
    ------
    ConfigError
        If an array has more microphones than an interface has inputs, if there are more interfaces than arrays, or if
        an array of `channels` does not exist.
    """
    given = dict(channels or {})
    strangers = set(given) - {array.name for array in arrays}
    if strangers:
        known = ", ".join(array.name for array in arrays)
        raise ConfigError(
            [Fault("--channels", f"expected one of the arrays {known}, got {name!r}") for name in sorted(strangers)]
        )
    if len(interfaces) > len(arrays):
        what = f"expected at most one interface for each array, got {len(interfaces)} for {len(arrays)}; name fewer"
        raise ConfigError([Fault("--interface", what)])
    share = -(-len(arrays) // len(interfaces))
    places = [_place(interfaces[0], connected)]
    waiting = list(interfaces[1:])
    for array in arrays:
        if waiting and len(places[-1].channels) == share:
            places.append(_place(waiting.pop(0), connected))
        found = places[-1].take(array.count, given.get(array.name))
        if found is None:
            places.append(_place(waiting.pop(0) if waiting else places[-1].interface, connected))
            found = places[-1].take(array.count)
        if found is None:
            free = len(places[-1].free or ())
            what = f"expected at most {free} microphones, the inputs of {places[-1].interface}, got {array.count}"
            raise ConfigError([Fault(f"array {array.name!r}", f"{what}; choose an interface with more inputs")])
        places[-1].channels[array.name] = found
    return tuple(_named(places, rate_hz))


def _place(interface: str, connected: Mapping[str, int]) -> _Place:
    known = known_interface(interface)
    if known is not None:
        return _Place(interface, list(known.microphones))
    counts = [inputs for name, inputs in connected.items() if interface.casefold() in name.casefold()]
    return _Place(interface, list(range(1, max(counts) + 1)) if counts else None)


def _named(places: Sequence[_Place], rate_hz: float | None) -> Iterator[DraftNode]:
    for number, place in enumerate(places, 1):
        known = known_interface(place.interface)
        own_hz = UNKNOWN_RATE_HZ if known is None else known.rate_hz
        name = "lab-pc" if len(places) == 1 else f"lab-pc-{number}"
        yield DraftNode(name, place.interface, rate_hz or own_hz, place.channels)
