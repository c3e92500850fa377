"""Views of `livessl levels`: a table redrawn on a terminal, lines of text, or JSON."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final, Protocol

from livessl.core.commission.levels import InputLevel
from livessl.core.commission.taps import Tap

Places = Mapping[int, tuple[str, int]]
"""Array and microphone (from 1) of each input (from 1) that the site file names."""

MOST_BAR: Final = 24
LEAST_BAR: Final = 6
"""Largest and least width of the bar of a level, in characters; a terminal without room for it shows none."""

BAR_DBFS: Final = -72.0
"""Level at which the bar begins."""

WORDS: Final = 20
"""Room for the words of the faults, in characters: for three of them."""

LAST_TAPS: Final = 3
"""Taps that stay below the table."""

_RED: Final = "\x1b[31m"
_PLAIN: Final = "\x1b[0m"


class View(Protocol):
    """A means to show the measurements of the command."""

    def levels(self, time_s: float, levels: Sequence[InputLevel]) -> None:
        """Show the levels of the last second."""
        ...

    def tap(self, tap: Tap) -> None:
        """Show a tap."""
        ...

    def problem(self, problem: str | None) -> None:
        """Show the problem of the device, or that it has none any more."""
        ...

    def summary(self, time_s: float, levels: Sequence[InputLevel]) -> None:
        """Show the levels since the beginning, at the end."""
        ...


class Lines:
    """Lines of text: a table for each second.

    Parameters
    ----------
    places : Places
    taps_only : bool
        Whether tables are left out until the summary.
    """

    def __init__(self, places: Places, *, taps_only: bool) -> None:
        self._places = places
        self._taps_only = taps_only

    def levels(self, time_s: float, levels: Sequence[InputLevel]) -> None:
        """Print the table."""
        if not self._taps_only:
            print("\n".join([f"after {time_s:.0f} s", *table(levels, self._places)]), flush=True)

    def tap(self, tap: Tap) -> None:
        """Print the tap."""
        print(tap_line(tap, self._places), flush=True)

    def problem(self, problem: str | None) -> None:
        """Print the problem to stderr."""
        print(f"livessl: {problem or 'the device delivers sound'}", file=sys.stderr, flush=True)

    def summary(self, time_s: float, levels: Sequence[InputLevel]) -> None:
        """Print the table."""
        print("\n".join([f"in all {time_s:.1f} s", *table(levels, self._places)]), flush=True)


class Objects:
    """One JSON object on each line.

    Parameters
    ----------
    places : Places
    """

    def __init__(self, places: Places) -> None:
        self._places = places

    def levels(self, time_s: float, levels: Sequence[InputLevel]) -> None:
        """Print an object for each input."""
        self._inputs("levels", time_s, levels)

    def tap(self, tap: Tap) -> None:
        """Print the tap; `input` is null where several inputs rose together."""
        inputs = [index + 1 for index in tap.inputs]
        one = inputs[0] if len(inputs) == 1 else None
        self._print("tap", {**asdict(tap), **self._place(one), "inputs": inputs})

    def problem(self, problem: str | None) -> None:
        """Print the problem; null where there is none any more."""
        self._print("problem", {"message": problem})

    def summary(self, time_s: float, levels: Sequence[InputLevel]) -> None:
        """Print an object for each input."""
        self._inputs("summary", time_s, levels)

    def _inputs(self, kind: str, time_s: float, levels: Sequence[InputLevel]) -> None:
        for number, level in enumerate(levels, 1):
            self._print(kind, {"time_s": time_s, **self._place(number), **asdict(level)})

    def _place(self, number: int | None) -> dict[str, Any]:
        array, microphone = self._places.get(number or 0, (None, None))
        return {"input": number, "array": array, "microphone": microphone}

    @staticmethod
    def _print(kind: str, data: Mapping[str, Any]) -> None:
        print(json.dumps({"kind": kind, **data}), flush=True)


class Screen:
    """A table on a terminal, redrawn in place, with the last taps and the problem below it.

    Parameters
    ----------
    name : str
        What is metered.
    places : Places
    """

    def __init__(self, name: str, places: Places) -> None:
        self._name = name
        self._places = places
        self._taps: list[str] = []
        self._problem: str | None = None
        self._time_s = 0.0
        self._drawn = 0
        self._color = "NO_COLOR" not in os.environ

    def levels(self, time_s: float, levels: Sequence[InputLevel]) -> None:
        """Draw the table."""
        self._time_s = time_s
        size = shutil.get_terminal_size()
        footer = [*self._taps, *([self._problem] if self._problem else []), "Ctrl-C ends"]
        lines = [f"{self._name}, {time_s:.0f} s", *table(levels, self._places, size.columns), *footer]
        room = max(size.lines - 1, len(footer) + 2)
        if len(lines) > room:
            hidden = len(lines) - room + 1
            kept = lines[: room - len(footer) - 1]
            lines = [*kept, f"{hidden} more inputs; make the window higher", *footer]
        self._draw([line[: size.columns - 1] for line in lines], levels)

    def tap(self, tap: Tap) -> None:
        """Keep the tap for the next drawing."""
        self._taps = [*self._taps[1 - LAST_TAPS :], tap_line(tap, self._places)]

    def problem(self, problem: str | None) -> None:
        """Draw the problem in place of the table, because levels of a while ago would mislead."""
        self._problem = problem
        if problem:
            self.levels(self._time_s, ())

    def summary(self, time_s: float, levels: Sequence[InputLevel]) -> None:
        """Replace the table by that of the whole time."""
        self._draw([f"{self._name}, in all {time_s:.1f} s", *table(levels, self._places), *self._taps], levels)

    def _draw(self, lines: Sequence[str], levels: Sequence[InputLevel]) -> None:
        words = {fault for level in levels for fault in level.faults} if self._color else set()
        up = f"\x1b[{self._drawn}A" if self._drawn else ""
        shown = [self._marked(line, words) for line in lines]
        sys.stdout.write(up + "".join(f"\x1b[2K{line}\n" for line in shown) + "\x1b[J")
        sys.stdout.flush()
        self._drawn = len(lines)

    @staticmethod
    def _marked(line: str, words: set[str]) -> str:
        """Return a line with the words of faults in red, if it is that of an input, which begins with a number."""
        if not line[:1].isdigit():
            return line
        kept = line.split(" ")
        return " ".join(f"{_RED}{word}{_PLAIN}" if word.strip(",") in words else word for word in kept)


def table(levels: Sequence[InputLevel], places: Places, columns: int = 0) -> list[str]:
    """Return the lines of a table with its heading; nothing without levels.

    Parameters
    ----------
    levels : sequence of InputLevel
    places : Places
    columns : int
        Width of the terminal, in which bars are drawn as far as there is room; 0 for none.
    """
    if not levels:
        return []
    numbers = range(1, len(levels) + 1)
    names = [
        f"{number} {places[number][0]}/{places[number][1]}" if number in places else f"{number}" for number in numbers
    ]
    width = max(map(len, [*names, "input"]))
    head = f"  {'peak':>6}  {'RMS':>6}  {'noise':>6}  {'clipped':>7}  {'DC':>6}  {'hum':>7}"
    unit = f"  {'dBFS':>6}  {'dBFS':>6}  {'dBFS':>6}  {'samples':>7}  {'%':>6}  {'Hz,dBFS':>7}"
    bar = min(MOST_BAR, columns - width - len(head) - WORDS - 2)
    blank = " " * (bar + 2) if bar >= LEAST_BAR else ""
    return [
        f"{'input':<{width}}{blank}{head}",
        f"{'':<{width}}{blank}{unit}",
        *(
            f"{name:<{width}}{'  ' + _bar(level, bar) if blank else ''}  {_row(level)}".rstrip()
            for name, level in zip(names, levels, strict=True)
        ),
    ]


def tap_line(tap: Tap, places: Places) -> str:
    """Return a sentence about a tap."""
    if len(tap.inputs) > 1:
        numbers = ", ".join(str(index + 1) for index in sorted(tap.inputs))
        return (
            f"{tap.time_s:7.1f} s  inputs {numbers} rose together: a sound in the room, or one signal on "
            "several inputs; tap a single microphone, lightly"
        )
    margin = "" if tap.margin_db is None else f", {tap.margin_db:.0f} dB over the next input"
    return (
        f"{tap.time_s:7.1f} s  tap on {place_name(tap.inputs[0] + 1, places, 'input ')}: "
        f"{tap.peak_dbfs:.0f} dBFS, {tap.rise_db:.0f} dB over its background{margin}"
    )


def place_name(number: int, places: Places, prefix: str = "") -> str:
    """Return the number of an input (from 1), with its array and microphone where the site file names them."""
    if number not in places:
        return f"{prefix}{number}"
    array, microphone = places[number]
    return f"{prefix}{number} ({array!r}, microphone {microphone})"


def _row(level: InputLevel) -> str:
    hum = "-" if level.hum_hz is None else f"{level.hum_hz:.0f}, {level.hum_dbfs:.0f}"
    mean = "-" if level.mean is None else f"{100.0 * level.mean:+.2f}"
    noise = "-" if level.noise_dbfs is None else f"{level.noise_dbfs:.1f}"
    return (
        f"{level.peak_dbfs:6.1f}  {level.rms_dbfs:6.1f}  {noise:>6}  {level.clipped:7d}  {mean:>6}  {hum:>7}  "
        f"{', '.join(level.faults)}"
    )


def _bar(level: InputLevel, width: int) -> str:
    """Return a bar up to the RMS, with a mark at the peak."""

    def at(value_dbfs: float) -> int:
        return min(width, max(0, round(width * (1.0 - value_dbfs / BAR_DBFS))))

    filled, peak = at(level.rms_dbfs), at(level.peak_dbfs)
    bar = "#" * filled + " " * (width - filled)
    return bar if peak <= filled else f"{bar[: peak - 1]}|{bar[peak:]}"
