"""How many clips `privacy: no-speech` drops: those with speech, and those without.

`python benchmarks/speech.py [--positions N] [--seed S] [--write docs/accuracy/speech.md]` takes the project's own
sounds and, where they are (LIVESSL_DATA), real ones: doors, keys, phones and speech, a talker before an array, and
claps in a laboratory. Dry sounds are put at random places of a simulated room, and noise is added. Each clip is
examined as a server does: all microphones of all arrays, and one of them with speech drops it. The enhanced signal,
which a server examines as well, is left out here.
"""

from __future__ import annotations

import argparse
import resource
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import soundfile
from scipy.signal import oaconvolve
from tqdm import tqdm

import claps
from clips import PRE_ROLL_S, RATE_HZ, TAIL_S, placed
from livessl.core.types import Float32Array, FloatArray
from livessl.server.clips.speech import LEAST_CHUNKS, LEAST_PROBABILITY, WINDOW, SpeechDetector
from livessl.server.clips.speech_main import CHUNK
from livessl.server.clips.speech_main import RATE_HZ as DETECTOR_HZ
from livessl.simulation.scene import NamedSound, read_sounds, synthesised_sounds
from recordings import DATA, TALKERS

RT60_S: Final = 0.7
SNRS_DB: Final = (30.0, 10.0)
"""Ratios of the sound, with its reflections, to white noise at the loudest microphone."""
WORD_S: Final = 0.25
"""Length, in seconds, of a short word: the loudest part of each clip of speech."""
BELOW_DB: Final = (10.0, 20.0, 30.0)
"""Levels of a voice below that of a door that slams meanwhile."""
LOUDER_DB: Final = (20.0, 30.0)
"""Levels of a steady sound above a voice: root mean squares, that of the voice while it is active."""
NOISE_LOUDER_DB: Final = (5.0, 10.0, 15.0)
"""Levels of white noise above a voice."""
VOICES: Final = ("speech", "voice")
STEADY: Final = "speech in"
"""Beginning of the names of clips with speech in a louder steady sound, which are counted apart from the others."""

HEAD: Final = """\
# How many clips are dropped for speech

With `privacy: no-speech` a server stores no [clip](../clips.md#without-speech) in which it detects speech. This page
says how many it drops. Sounds are at random places in a simulated room of 8 x 10 x 4 m with a reverberation time of
{rt60_s:g} s and two arrays of four microphones, with white noise at the given ratio (SNR). Each clip begins
{pre_ms:.0f} ms before its sound, as clips usually do.
Steady sounds are as much louder than the voice or the door as the table says: root mean squares, at the microphone
where it is loudest, and while it lasts; the other noise is 40 dB below the voice then.
`python benchmarks/speech.py --positions {positions} --seed {seed} --write docs/accuracy/speech.md` writes this page;
the real sounds are not part of the project. A clip is dropped if {chunks} of {window} consecutive chunks of
{chunk_ms:.0f} ms have a probability of speech of {least:g} or more, at any microphone. The numbers of the rule were
chosen with some of these sounds, in a measured room and at one microphone.

| sound | SNR | clips | dropped |
|---|---|---|---|"""


@dataclass(frozen=True)
class Row:
    """The clips of one kind, and how many of them were dropped."""

    what: str
    snr: str
    clips: int
    dropped: int


def in_room(sounds: Sequence[NamedSound], count: int, seed: int) -> Iterator[tuple[str, Float32Array]]:
    """Yield the names of sounds, and what all microphones (8, n) receive of each at a random place, without noise."""
    for source, responses in placed(sounds, count, RT60_S, seed):
        before, after = round(PRE_ROLL_S * RATE_HZ), round(TAIL_S * RATE_HZ)
        wet = oaconvolve(responses, source.sound[None], axes=1)[:, : len(source.sound) + after]
        yield source.name, np.pad(wet, ((0, 0), (before, 0))).astype(np.float32)


def noisy(received: Float32Array, snr_db: float, rng: np.random.Generator) -> Float32Array:
    """Return received sound (K, n) with white noise; the ratio is that of the loudest microphone while it lasts."""
    power = np.square(received[:, round(PRE_ROLL_S * RATE_HZ) :]).mean(axis=1).max()
    hiss = rng.standard_normal(received.shape) * np.sqrt(power / 10.0 ** (snr_db / 10.0))
    return np.asarray(received + hiss, dtype=np.float32)


def loudest(sound: Float32Array, length: int) -> Float32Array:
    """Return the loudest part of a sound, of a number of samples."""
    power = np.convolve(np.square(sound), np.ones(length), "valid")
    first = int(power.argmax()) if len(power) else 0
    return sound[first : first + length]


class MeteredDetector(SpeechDetector):
    """A detector that notes how many seconds of channels it has examined."""

    def __init__(self) -> None:
        super().__init__()
        self.examined_s = 0.0

    def probabilities(self, samples: Float32Array, sample_rate_hz: float) -> FloatArray:
        """Return the probabilities as the detector does."""
        self.examined_s += len(samples) / sample_rate_hz
        return super().probabilities(samples, sample_rate_hz)

    def processor_ms(self) -> float:
        """Return the processor time, in milliseconds, for each second of a channel; the process must have ended."""
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return 1e3 * (used.ru_utime + used.ru_stime) / self.examined_s


class Examined:
    """Clips by kind, and how many of each kind are dropped."""

    def __init__(self, detector: SpeechDetector, seed: int) -> None:
        self._detector = detector
        self._rng = np.random.default_rng(seed)
        self.rows: list[Row] = []

    def add(self, what: str, snr: str, clips: Sequence[Float32Array], rate_hz: float = RATE_HZ) -> None:
        """Examine clips (K, n) of one kind."""
        bar = tqdm(clips, what, leave=False)
        dropped = sum(self._detector.has_speech([(clip, rate_hz)]) for clip in bar)
        self.rows.append(Row(what, snr, len(clips), dropped))

    def add_noisy(self, what: str, received: Sequence[Float32Array], snrs_db: Sequence[float] = SNRS_DB) -> None:
        """Examine what microphones receive, in noise."""
        for snr_db in snrs_db:
            self.add(what, f"{snr_db:g} dB", [noisy(each, snr_db, self._rng) for each in received])


def add_own(examined: Examined, positions: int, seed: int) -> None:
    """Examine the project's own sounds."""
    found: dict[str, list[Float32Array]] = {}
    for name, received in in_room(synthesised_sounds(RATE_HZ, seed), positions, seed):
        found.setdefault(name, []).append(received)
    for name in sorted(found):
        examined.add_noisy(f"{name.replace('_', ' ')}, synthesised", found[name])


def add_real(examined: Examined, seed: int) -> None:
    """Examine real sounds."""
    sounds = read_sounds(DATA / "dcase2016_task2", float(RATE_HZ))
    kinds = sorted({name.rstrip("0123456789") for name, _ in sounds})
    received: dict[str, list[Float32Array]] = {}
    for kind in kinds:
        some = [(name, sound) for name, sound in sounds if name.rstrip("0123456789") == kind]
        received[kind] = [each for _, each in in_room(some, len(some), seed)]
        examined.add_noisy(kind, received[kind])
    speech = [(name, sound) for name, sound in sounds if name.startswith("speech")]
    words = [(name, loudest(sound, round(WORD_S * RATE_HZ))) for name, sound in speech]
    examined.add_noisy(f"speech of {WORD_S:g} s", [each for _, each in in_room(words, len(words), seed)])
    for below_db in BELOW_DB:
        pairs = zip(received["speech"], received["doorslam"], strict=False)
        mixed = [_mixed(voice, door, below_db) for voice, door in pairs]
        examined.add_noisy(f"speech {below_db:g} dB below a door", mixed, SNRS_DB[:1])

    add_in_steady_sound(examined, received["speech"], received["doorslam"], seed)


def add_in_steady_sound(
    examined: Examined, voices: Sequence[Float32Array], doors: Sequence[Float32Array], seed: int
) -> None:
    """Examine voices in louder hum, offset and noise, and doors in hum. The noise alone differs between microphones."""
    rng = np.random.default_rng(seed)

    def tone(shape: tuple[int, ...], frequency_hz: float) -> FloatArray:
        phase = 2.0 * np.pi * (frequency_hz * np.arange(shape[-1]) / RATE_HZ + rng.uniform())
        return np.broadcast_to(np.sqrt(2.0) * np.sin(phase), shape)

    for what, levels_db, make in (
        ("hum of 50 Hz", LOUDER_DB, lambda shape: tone(shape, 50.0)),
        ("hum of 60 Hz", LOUDER_DB, lambda shape: tone(shape, 60.0)),
        ("a constant offset", LOUDER_DB, np.ones),
        ("white noise", NOISE_LOUDER_DB, rng.standard_normal),
        ("a tone of 1 kHz", LOUDER_DB[:1], lambda shape: tone(shape, 1000.0)),
    ):
        for level_db in levels_db:
            clips = [with_steady(each, make(each.shape), level_db) for each in voices]
            examined.add(f"{STEADY} {what} {level_db:g} dB louder", "", clips)
    clips = [with_steady(each, tone(each.shape, 50.0), LOUDER_DB[0]) for each in doors]
    examined.add(f"doorslam in hum of 50 Hz {LOUDER_DB[0]:g} dB louder", "", clips)


def with_steady(received: Float32Array, steady: FloatArray, louder_db: float) -> Float32Array:
    """Return received sound (K, n) with a steady one of root mean square 1, and faint white noise."""
    level = active_rms(received)
    faint = 0.01 * np.random.default_rng(received.shape[1]).standard_normal(received.shape)
    return np.asarray(received + level * (10.0 ** (louder_db / 20.0) * steady + faint), dtype=np.float32)


def active_rms(received: Float32Array) -> float:
    """Return the root mean square of received sound (K, n) at the loudest microphone, where it is active."""
    loudest_one = received[np.square(received).sum(axis=1).argmax()]
    active = np.abs(loudest_one) > 0.05 * np.abs(loudest_one).max()
    return float(np.sqrt(np.square(loudest_one[active]).mean()))


def _mixed(voice: Float32Array, door: Float32Array, below_db: float) -> Float32Array:
    count = max(voice.shape[1], door.shape[1])
    voice, door = (np.pad(each, ((0, 0), (0, count - each.shape[1]))) for each in (voice, door))
    ratio = np.abs(door).max() / np.abs(voice).max()
    return np.asarray(door + voice * ratio * 10.0 ** (-below_db / 20.0), dtype=np.float32)


def add_recorded(examined: Examined) -> None:
    """Examine what real arrays have recorded: a talker, and claps."""
    for take in TALKERS:
        tracks = [
            soundfile.read(DATA / "respeaker_4mic" / take / f"track{k}.wav", dtype="float32") for k in range(2, 6)
        ]
        examined.add(f"a talker, {take}", "as recorded", [np.stack([one for one, _ in tracks])], float(tracks[0][1]))
    found = [claps.samples_of(name) for name in claps.names()]
    examined.add("claps", "as recorded", [samples for samples, _ in found], found[0][1])


def report(rows: Sequence[Row], positions: int, seed: int, processor_ms: float) -> str:
    """Return the page of the results."""
    head = HEAD.format(
        rt60_s=RT60_S, pre_ms=1e3 * PRE_ROLL_S, positions=positions, seed=seed, chunks=LEAST_CHUNKS, window=WINDOW,
        chunk_ms=1e3 * CHUNK / DETECTOR_HZ, least=LEAST_PROBABILITY,
    )  # fmt: skip
    lines = [
        f"| {row.what} | {row.snr} | {row.clips} | {row.dropped} ({100.0 * row.dropped / row.clips:.0f} %) |"
        for row in rows
    ]
    spoken = [row for row in rows if row.what.startswith((*VOICES, "a talker"))]
    in_steady = [row for row in spoken if row.what.startswith(f"{STEADY} ")]
    kinds = {
        "with speech": [row for row in spoken if row not in in_steady],
        "with speech in a louder steady sound": in_steady,
        "without speech": [row for row in rows if row not in spoken],
    }
    sums = []
    for what, some in kinds.items():
        if not some:
            continue
        clips, dropped = sum(row.clips for row in some), sum(row.dropped for row in some)
        sums.append(f"Of all {clips} clips {what}, {dropped} ({100.0 * dropped / clips:.1f} %) are dropped.")
    cost = f"The process of the detector took {processor_ms:.0f} ms of processor time for each second of a channel."
    return "\n".join([head, *lines, "", *sums, cost]) + "\n"


def main() -> None:
    """Measure, print, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--positions", type=int, default=40, help="own sounds in the room (default: 40)")
    parser.add_argument("--seed", type=int, default=2, help="seed of places, sounds and noise (default: 2)")
    parser.add_argument("--write", type=Path, help="file for the page")
    arguments = parser.parse_args()
    detector = MeteredDetector()
    examined = Examined(detector, arguments.seed)
    try:
        add_own(examined, arguments.positions, arguments.seed)
        if DATA.is_dir():
            add_real(examined, arguments.seed)
            add_recorded(examined)
    finally:
        detector.close()
    page = report(examined.rows, arguments.positions, arguments.seed, detector.processor_ms())
    print(page)
    if arguments.write is not None:
        arguments.write.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
