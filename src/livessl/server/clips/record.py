"""Makes one event's clip in memory, then writes it: each array, and one signal beamed towards the event's position.

Another file format of clips also concerns `recordings/sound_file.py` (reading and writing), `schema/clips.py` (the
answers' `format`) and `server/api/clip_routes.py` (media types).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from livessl.clock import utc_text
from livessl.core.enhance.enhance import Enhancement, plan
from livessl.core.types import Event, Float32Array, FloatArray
from livessl.recordings.sound_file import FLAC_MAX_CHANNELS, Format, SoundWriter
from livessl.server.api.encode import answer
from livessl.server.clips.cut import Cut

ENHANCED: Final = "enhanced.flac"
"""Name of the enhanced signal."""

PEAK: Final = 10.0 ** (-3.0 / 20.0)
"""Largest sample of the enhanced signal, -3 dB full scale: most sounds of a room are too quiet to be listened to."""

MOST_GAIN: Final = 1000.0
"""Largest gain, 60 dB, by which the enhanced signal is made louder."""


OFF: Final = "the site file has turned it off (server.clips.enhanced)"
NO_PLACE: Final = "the event has neither a place nor a direction to which a beam could be steered"
NO_FRAMES: Final = "no frame of the event itself is left of the arrays that it was located by"
"""Why a clip has no enhanced signal."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """An event, and the recordings that its clip is made of.

    Parameters
    ----------
    event : Event
    cuts : tuple of Cut
        What the arrays recorded around it.
    enhanced : bool
        Whether the signal beamed at the place is written, too.
    c_m_s : float
        Speed of sound, m/s.
    """

    event: Event
    cuts: tuple[Cut, ...]
    enhanced: bool
    c_m_s: float


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording in memory, which is still to be written.

    Parameters
    ----------
    name : str
        Name of its file.
    format : "flac" or "wav"
    samples : (K, n) float32
    sample_rate_hz : float
    about : mapping
        Its description, as `ClipFile` has it, but for what follows from the samples and the file.
    """

    name: str
    format: Format
    samples: Float32Array
    sample_rate_hz: float
    about: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Made:
    """The recordings of a clip in memory, the enhanced one first.

    Parameters
    ----------
    recipe : Recipe
    recordings : tuple of Recording
    no_enhanced : str or None
        Why there is no enhanced signal; None if there is one.
    """

    recipe: Recipe
    recordings: tuple[Recording, ...]
    no_enhanced: str | None


def make_clip(recipe: Recipe) -> Made:
    """Return the recordings of a clip; nothing is written."""
    arrays = [_array(recipe.event, cut) for cut in recipe.cuts]
    enhanced = _enhanced(recipe) if recipe.enhanced else OFF
    if isinstance(enhanced, str):
        return Made(recipe, tuple(arrays), enhanced)
    return Made(recipe, (enhanced, *arrays), None)


def write_clip(made: Made, folder: Path) -> dict[str, Any]:
    """Write the recordings of a clip into a folder, and return their description for JSON.

    Raises
    ------
    OSError
        If the disk does not take them.
    """
    event, recipe = made.recipe.event, made.recipe
    estimate = event.estimate
    return {
        "event_id": event.id,
        "start_ns": event.start_ns,
        "time_utc": utc_text(event.start_ns),
        "duration_s": round(event.duration_s, 6),
        "position_m": None if estimate is None else [round(float(x), 4) for x in estimate.position_m],
        "files": [_write(recording, folder) for recording in made.recordings],
        "no_enhanced": made.no_enhanced,
        "answer": answer(event),
        "c_m_s": recipe.c_m_s,
        "arrays": {cut.spec.name: _set_up_and_frames(cut) for cut in recipe.cuts},
    }


def _set_up_and_frames(cut: Cut) -> dict[str, Any]:
    """Return what locating the event again needs besides the samples: where the microphones are, and the frames."""
    return {
        "time_ns": cut.time_ns,
        "sample_rate_hz": cut.sample_rate_hz,
        "microphones_m": cut.spec.microphones_m.tolist(),
        "uncertainty": asdict(cut.spec.uncertainty),
        "frames": [list(astuple(frame)) for frame in cut.frames],
    }


def _array(event: Event, cut: Cut) -> Recording:
    kind: Format = "flac" if len(cut.samples) <= FLAC_MAX_CHANNELS else "wav"
    pre_roll_s = (event.start_ns - cut.time_ns) / 1e9
    about = {
        "kind": "array",
        "array": cut.spec.name,
        "time_utc": utc_text(cut.time_ns),
        "pre_roll_s": round(pre_roll_s, 4),
        "post_roll_s": round(cut.duration_s - pre_roll_s - event.duration_s, 4),
        "gaps_s": [[round(begin, 4), round(end, 4)] for begin, end in cut.gaps_s],
        "gain_db": 0.0,
        "beams": [],
    }
    return Recording(f"array-{cut.spec.name}.{kind}", kind, cut.samples, cut.sample_rate_hz, about)


def _enhanced(recipe: Recipe) -> Recording | str:
    """Return the enhanced signal from the arrays that the estimate used; in words, why there is none."""
    event, estimate = recipe.event, recipe.event.estimate
    if estimate is None:
        return NO_PLACE
    used = [cut for cut in recipe.cuts if cut.spec.name in estimate.arrays]
    sounds = [cut.sound(event.start_ns, event.end_ns) for cut in used]
    sounds = [sound for sound in sounds if sound.sound.any()]
    if not sounds:
        return NO_FRAMES
    made = plan(sounds, estimate.position_m, recipe.c_m_s)
    signal = made.apply({sound.spec.name: sound.samples for sound in sounds})
    gain = _gain(signal)
    pre_roll_s = (event.start_ns - made.time_ns) / 1e9
    about = {
        "kind": "enhanced",
        "array": None,
        "time_utc": utc_text(made.time_ns),
        "pre_roll_s": round(pre_roll_s, 4),
        "post_roll_s": round(len(signal) / made.sample_rate_hz - pre_roll_s - event.duration_s, 4),
        "gaps_s": [],
        "gain_db": round(20.0 * float(np.log10(gain)), 1),
        "beams": _beams(made),
    }
    samples = np.asarray(gain * signal[None], dtype=np.float32)
    return Recording(ENHANCED, "flac", samples, made.sample_rate_hz, about)


def _beams(made: Enhancement) -> Sequence[Mapping[str, Any]]:
    return [
        {
            "array": part.array,
            "share": round(part.share, 3),
            "lag_s": round(part.lag_s, 5),
            "snr_db": None if part.snr_db is None else round(part.snr_db, 1),
        }
        for part in made.parts
    ]


def _write(recording: Recording, folder: Path) -> dict[str, Any]:
    """Write a recording, and return its description as `ClipFile` has it."""
    path, samples = folder / recording.name, recording.samples
    writer = SoundWriter(path, round(recording.sample_rate_hz), len(samples), recording.format)
    try:
        writer.write(samples)
    finally:
        writer.close()
    return {
        "name": recording.name,
        **recording.about,
        "channels": len(samples),
        "sample_rate_hz": round(recording.sample_rate_hz),
        "duration_s": round(samples.shape[1] / recording.sample_rate_hz, 4),
        "bytes": path.stat().st_size,
    }


def _gain(signal: FloatArray) -> float:
    peak = float(np.abs(signal).max(initial=0.0))
    return 1.0 if peak == 0.0 else min(PEAK / peak, MOST_GAIN)
