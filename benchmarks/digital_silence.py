"""Streams with digital silence: what is taken for sound in the noise after it, and which sounds are lost.

`python benchmarks/digital_silence.py --events DIR [--streams N] [--seed S]`. The sounds between silences without any
noise are those of DCASE 2016 task 2. The results are in docs/accuracy/robustness.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from livessl.core.stream.activity import ActivityParameters
from livessl.core.stream.segmenter import Segmenter
from livessl.core.stream.timeline import Framer
from livessl.core.types import FRAME_NS, ArraySpec, Block, BoolArray, Float32Array, FloatArray, Frame
from livessl.lab.evaluate.job import read_clips
from livessl.lab.evaluate.paper import BAND_HZ, CLASSES

RATE_HZ: Final = 16000
FRAME: Final = 800
START: Final = 20 * 1_700_000_000
SPEC: Final = ArraySpec("array", 0.1 * np.vstack([np.zeros(3), np.eye(3)]), BAND_HZ)

SILENCES_S: Final = (0.05, 0.13, 0.2, 0.5, 1.3, 2.9, 5.0)
"""Digital silence at the start of a stream, in seconds."""

DROPOUTS_S: Final = (0.2, 1.0, 4.0)
"""Longest dropout of a stream, and longest noise between two, in seconds."""

RINGS_S: Final = (1.0, 2.5, 8.0)
"""Length of a steady ring, in seconds."""

SNRS_DB: Final = (10.0, 20.0)
"""Ratio of the loudest 50 ms of a sound to the noise, in decibels."""

ROOMS_S: Final = (0.05, 0.7, 2.0)
"""Reverberation times, in seconds, of the sounds without noise."""

CLIPS: Final = 5
"""Sounds in a stream without noise."""


def active_frames(samples: FloatArray, spec: ArraySpec = SPEC) -> BoolArray:
    """Return which frames of a stream (4, n) are sent as active: (F,)."""
    framer = Framer(float(RATE_HZ))
    segmenter = Segmenter(spec, np.arange(4), float(RATE_HZ), ActivityParameters())
    messages = []
    for index in range(0, samples.shape[1], 480):
        block = Block(
            index, samples[:, index : index + 480].astype(np.float32), START * FRAME_NS + index * 10**9 // RATE_HZ
        )
        messages += [message for cut in framer.push(block) for message in segmenter.push(cut, framer.state)]
    messages += segmenter.flush(framer.state)
    active = np.zeros(samples.shape[1] // FRAME + 1, dtype=np.bool_)
    active[[m.frame_index - START for m in messages if isinstance(m, Frame) and m.active]] = True
    return active


def zeros(seconds: float) -> FloatArray:
    """Return digital silence (4, n)."""
    return np.zeros((4, round(seconds * RATE_HZ)))


def noise(rng: np.random.Generator, seconds: float, level: float) -> FloatArray:
    """Return steady noise (4, n), white or the low noise of a fan."""
    count = round(seconds * RATE_HZ)
    frequency_hz = np.fft.rfftfreq(count, 1.0 / RATE_HZ)
    spectrum = np.fft.rfft(rng.standard_normal((4, count))) / np.maximum(frequency_hz, 100.0) ** rng.uniform(0.0, 0.8)
    wave = np.fft.irfft(spectrum, count)
    return np.asarray(level * wave / wave.std())


def decaying(rng: np.random.Generator, seconds: float, rt60_s: float) -> FloatArray:
    """Return noise (4, n) that decays by 60 dB in `rt60_s`."""
    times_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    return np.asarray(rng.standard_normal((4, len(times_s))) * 10.0 ** (-3.0 * times_s / rt60_s))


def judge_late_burst(rng: np.random.Generator, parts: Sequence[FloatArray], level: float) -> tuple[bool, bool]:
    """Play noise with a burst 3 s before its end; return whether a false sound comes, and whether the burst is lost."""
    samples = np.concatenate(parts, axis=1)
    begin = samples.shape[1] - 3 * RATE_HZ
    burst = 20.0 * level * decaying(rng, 0.4, 0.65)
    samples[:, begin : begin + burst.shape[1]] += burst
    active = active_frames(samples)
    return bool(active[: begin // FRAME - 1].any()), not active[begin // FRAME : begin // FRAME + 3].any()


def noise_after_silence(streams: int, seed: int, silence_s: float) -> str:
    """Play silence, noise, and a burst 5 s later; return a row: false sounds, and bursts that are lost."""
    false = lost = 0
    for number in range(streams):
        rng = np.random.default_rng([seed, number, round(1000 * silence_s)])
        level = 10.0 ** (rng.uniform(-80.0, -30.0) / 20.0)
        parts = [zeros(silence_s + rng.uniform(0.0, 0.05)), noise(rng, 8.0, level)]
        is_false, is_lost = judge_late_burst(rng, parts, level)
        false, lost = false + is_false, lost + is_lost
    return f"| {silence_s:g} s of silence, then noise | {streams} | {false} | {lost} |"


def clap_after_silence(streams: int, seed: int) -> str:
    """Play silence and noise with a clap in its first half second; return a row: claps that go on, and lost ones."""
    goes_on = lost = 0
    for number in range(streams):
        rng = np.random.default_rng([seed, number])
        level, rt60_s, lead = 10.0 ** (rng.uniform(-80.0, -40.0) / 20.0), rng.uniform(0.1, 1.5), rng.uniform(0.0, 0.5)
        sound = noise(rng, 6.0, level)
        first = round(lead * RATE_HZ)
        sound[:, first:] += 20.0 * level * decaying(rng, 7.0, rt60_s)[:, : sound.shape[1] - first]
        silence = zeros(rng.uniform(0.1, 3.0))
        active = active_frames(np.concatenate([silence, sound], axis=1))
        begin = (silence.shape[1] + first) // FRAME
        lost += not active[begin : begin + 2].any()
        goes_on += bool(active[begin + round(0.5 * rt60_s * RATE_HZ / FRAME) + 8 :].any())
    return f"| silence, then a clap in noise | {streams} | {goes_on} | {lost} |"


def noise_between_dropouts(streams: int, seed: int, longest_s: float) -> str:
    """Play noise with two to eight dropouts, and a burst 5 s later; return a row: false sounds, and lost bursts."""
    false = lost = 0
    for number in range(streams):
        rng = np.random.default_rng([seed, number, round(1000 * longest_s)])
        level = 10.0 ** (rng.uniform(-80.0, -30.0) / 20.0)
        parts = [noise(rng, 3.0, level)]
        for _ in range(int(rng.integers(2, 9))):
            parts += [zeros(rng.uniform(0.01, longest_s)), noise(rng, rng.uniform(0.05, longest_s), level)]
        is_false, is_lost = judge_late_burst(rng, [*parts, noise(rng, 8.0, level)], level)
        false, lost = false + is_false, lost + is_lost
    return f"| noise with dropouts of up to {longest_s:g} s | {streams} | {false} | {lost} |"


def ring_out_of_silence(streams: int, seed: int, length_s: float) -> str:
    """Play silence and a steady ring that travels to each microphone; return a row: rings found late, and lost ones."""
    late = lost = 0
    for number in range(streams):
        rng = np.random.default_rng([seed, number, round(1000 * length_s)])
        t_s = np.arange(round(length_s * RATE_HZ)) / RATE_HZ
        ring = sum(np.sin(2.0 * np.pi * hz * t_s) for hz in rng.uniform(400.0, 3000.0, 3))
        size, edge_m, rt60_s = rng.uniform(3.0, 20.0), rng.uniform(0.1, 0.6), rng.uniform(0.1, 2.0)
        source_m = rng.uniform(0.1, 0.9, 3) * size
        microphones_m = edge_m / 0.1 * SPEC.microphones_m + rng.uniform(0.2, 0.8, 3) * size
        samples = zeros(length_s + 3.0 + 2.0 * rt60_s)
        begin = round(rng.uniform(0.3, 2.0) * RATE_HZ)
        delays = np.round(np.linalg.norm(microphones_m - source_m, axis=1) / 343.0 * RATE_HZ).astype(int)
        for row, delay in zip(samples, delays.tolist(), strict=True):
            tail = 0.05 * decaying(rng, rt60_s, rt60_s)[0]
            tail[0] = 1.0
            wet = np.convolve(ring, tail) * 10.0 ** (-35.0 / 20.0)
            row[begin + delay : begin + delay + len(wet)] += wet[: len(row) - begin - delay]
        active = active_frames(samples, replace(SPEC, microphones_m=microphones_m))
        first, last = (begin + int(delays.min())) // FRAME, (begin + int(delays.max()) + len(ring)) // FRAME
        lost += not active[first : last + 1].any()
        late += not active[first : first + 3].any()
    return f"| silence, then a steady ring of {length_s:g} s, RT60 0.1 to 2 s | {streams} | {late} | {lost} |"


def machine_begins(streams: int, seed: int, background: float) -> str:
    """Play a machine that begins after 4 s and lasts 10 s; return a row: those that are late or too long, and lost.

    Too long is more than 4.5 s: a steady sound becomes background after 3 s, and its last frames end later.
    """
    long = lost = 0
    for number in range(streams):
        rng = np.random.default_rng([seed, number])
        samples = background * noise(rng, 16.0, 1.0)
        begin = 4 * RATE_HZ
        machine = noise(rng, 10.0, 10.0 ** (rng.uniform(-50.0, -20.0) / 20.0))[0]
        for channel, row in enumerate(samples):
            row[begin + 3 * channel : begin + 3 * channel + len(machine)] += machine
        active = active_frames(samples)
        first = begin // FRAME
        lost += not active[first : first + 200].any()
        long += not active[first : first + 3].any() or bool(active[first + 90 : first + 200].any())
    where = "digital silence" if background == 0.0 else "noise"
    return f"| {where}, then a machine of 10 s | {streams} | {long} | {lost} |"


def clips_in_noise(clips: Sequence[Float32Array], streams: int, seed: int, snr_db: float) -> str:
    """Play sounds in steady noise; return a row: streams whose first sound is lost, and all lost sounds."""
    first = lost = 0
    for number in range(streams):
        rng = np.random.default_rng([seed, number, round(snr_db)])
        parts, spans = [zeros(3.0)], []
        for _ in range(CLIPS):
            clip = np.convolve(clips[int(rng.integers(len(clips)))], 0.3 * decaying(rng, 0.4, 0.4)[0])
            loudest = max(float(np.square(clip[at : at + FRAME]).mean()) for at in range(0, len(clip), FRAME))
            begin = sum(part.shape[1] for part in parts)
            spans.append(slice(begin // FRAME, (begin + len(clip)) // FRAME + 1))
            parts += [np.tile(clip / np.sqrt(loudest), (4, 1)), zeros(rng.uniform(1.0, 4.0))]
        samples = np.concatenate(parts, axis=1)
        active = active_frames(1e-2 * (samples + noise(rng, samples.shape[1] / RATE_HZ, 10.0 ** (-snr_db / 20.0))))
        missed = [not active[span].any() for span in spans]
        first, lost = first + missed[0], lost + sum(missed)
    return f"| {CLIPS} sounds in noise at {snr_db:g} dB | {streams} | {first} | {lost} |"


def clips_in_silence(clips: Sequence[Float32Array], streams: int, seed: int, rt60_s: float) -> str:
    """Play sounds with silence between them; return a row: streams whose first sound is lost, and all lost sounds."""
    first = lost = 0
    for number in range(streams):
        rng = np.random.default_rng([seed, number, round(1000 * rt60_s)])
        tail = 0.3 * decaying(rng, rt60_s, rt60_s)
        tail[:, 0] = 3.0
        parts, spans = [zeros(rng.uniform(0.1, 3.0))], []
        for _ in range(CLIPS):
            clip = clips[int(rng.integers(len(clips)))]
            wet = np.stack([np.convolve(clip, one) for one in tail]) * 0.1 * 10.0 ** (rng.uniform(-20.0, 0.0) / 20.0)
            begin = sum(part.shape[1] for part in parts)
            spans.append(slice(begin // FRAME, (begin + wet.shape[1]) // FRAME + 1))
            parts += [wet, zeros(rng.uniform(0.6, 5.0))]
        active = active_frames(np.concatenate(parts, axis=1))
        missed = [not active[span].any() for span in spans]
        first, lost = first + missed[0], lost + sum(missed)
    return f"| {CLIPS} sounds without noise, RT60 {rt60_s:g} s | {streams} | {first} | {lost} |"


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--events", type=Path, required=True, help="folder with the clips of DCASE 2016 task 2")
    parser.add_argument("--streams", type=int, default=30, help="streams of each row (30)")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    clips = [clip for each in read_clips(given.events, CLASSES, float(RATE_HZ)).values() for _, clip in each]
    print("| | streams | with a false sound, a sound that goes on or is late, or the first lost | sounds lost |")
    print("|---|---|---|---|")
    for silence_s in SILENCES_S:
        print(noise_after_silence(given.streams, given.seed, silence_s), flush=True)
    print(clap_after_silence(given.streams, given.seed), flush=True)
    for longest_s in DROPOUTS_S:
        print(noise_between_dropouts(given.streams, given.seed, longest_s), flush=True)
    for length_s in RINGS_S:
        print(ring_out_of_silence(given.streams, given.seed, length_s), flush=True)
    for rt60_s in ROOMS_S:
        print(clips_in_silence(clips, given.streams, given.seed, rt60_s), flush=True)
    for background in (0.0, 1e-4):
        print(machine_begins(given.streams, given.seed, background), flush=True)
    for snr_db in SNRS_DB:
        print(clips_in_noise(clips, given.streams, given.seed, snr_db), flush=True)


if __name__ == "__main__":
    main()
