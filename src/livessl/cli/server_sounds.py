"""Reads the last sounds of a running server, one after the other, for commands that calibrate live."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from livessl.calibration import HeardSound
from livessl.cli.server_answers import ask_for
from livessl.clock import SystemClock, instant_ns
from livessl.core.types import Observation
from livessl.errors import ConfigError, RunError
from livessl.schema import answers
from livessl.server.api import set_up_schema
from livessl.site.load import parse_site
from livessl.site.models import Site

POLL_S: Final = 0.25
"""Interval, in seconds, at which the server is asked for new sounds."""


@dataclass(frozen=True, slots=True)
class Answer:
    """An answer of the server: its time, the number of its last sound, and sounds with their starts in nanoseconds."""

    now_ns: int
    last: int
    sounds: Sequence[tuple[int, HeardSound]]


class ServerSounds:
    """The sounds that a running server finishes.

    Parameters
    ----------
    url : str
        Address of the server.
    token_file : Path or None
        File that holds a token.
    wait_s : float
        Longest wait for a sound, seconds.
    """

    def __init__(self, url: str, token_file: Path | None, wait_s: float) -> None:
        self._url, self._token_file, self._wait_s = url, token_file, wait_s
        self._clock = SystemClock()

    def site(self) -> Site:
        """Return the server's site as far as calibration needs it: room, arrays and speed of sound.

        Raises
        ------
        UseError
            If the address of the server cannot be used.
        RunError
            If there is no answer, or none that describes a site.
        """
        used: Any = {
            "site": True,
            "room": True,
            "grid": {"bounds_m", "spacing_m"},
            "speed_of_sound_m_s": True,
            "band_hz": True,
            "arrays": {"__all__": {"microphones_m", "band_hz"}},
        }
        try:
            return parse_site(json.dumps(self._described().model_dump(mode="json", include=used)))
        except ConfigError as error:
            raise RunError(f"{self._url}: cannot use the site of the server: {error}; check the address") from error

    def has_joint_arrays(self) -> bool:
        """Return whether the server joins arrays, so that `site` does not say how its site file names them."""
        return bool(self._described().joint)

    def kept(self) -> list[HeardSound]:
        """Return the sounds that the server still keeps, the oldest first."""
        return [sound for _, sound in self._after(0).sounds]

    def next_sound(self, ask_user: Callable[[], None], what: str, accepts: Callable[[HeardSound], bool]) -> HeardSound:
        """Wait for a sound that begins from now on.

        Parameters
        ----------
        ask_user : callable
            Asks the user for the sound; a sound that follows at once counts.
        what : str
            What is waited for, in words.
        accepts : callable
            Gets a sound, and says whether it is the one.

        Raises
        ------
        RunError
            If none comes in time.
        """
        begin = self._after(2**53)
        ask_user()
        number, deadline_ns = begin.last, self._clock.monotonic_ns() + round(1e9 * self._wait_s)
        while self._clock.monotonic_ns() < deadline_ns:
            answer = self._after(number)
            number = answer.last
            for start_ns, sound in answer.sounds:
                if start_ns >= begin.now_ns and accepts(sound):
                    return sound
            self._clock.sleep_until_ns(self._clock.now_ns() + round(1e9 * POLL_S))
        raise RunError(
            f"expected {what} within {self._wait_s:g} s, and the server finished no sound; check with livessl levels "
            "that the microphones receive it, clap louder, or give a longer --wait"
        )

    def _after(self, number: int) -> Answer:
        answer = ask_for(set_up_schema.HeardSounds, self._url, f"sounds?after={number}", self._token_file)
        sounds = [(instant_ns(one.time_utc), _sound(one)) for one in answer.sounds]
        return Answer(instant_ns(answer.now_utc), answer.last, sounds)

    def _described(self) -> answers.Site:
        return ask_for(answers.Site, self._url, "site", self._token_file)


def _sound(one: set_up_schema.HeardSound) -> HeardSound:
    position_m = None if one.position_m is None else np.array(one.position_m, dtype=np.float64)
    observations = tuple(_observation(each) for each in one.observations)
    start_s = instant_ns(one.time_utc) / 1e9
    return HeardSound(start_s, position_m, str(one.status), one.reason, observations)


def _observation(one: set_up_schema.ObservedDelays) -> Observation:
    return Observation(
        one.array,
        1e-6 * np.array([np.nan if delay is None else delay for delay in one.delays_us], dtype=np.float64),
        np.array(one.inverted, dtype=bool),
        np.array(one.coherence, dtype=np.float64),
        np.array(one.powers, dtype=np.float64),
        one.sharpness,
        1e-6 * one.closure_us,
    )
