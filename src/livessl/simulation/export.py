"""Writes a simulated scene as a session: WAV files, `truth.jsonl`, and the data for replay."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Final

import numpy as np
import soundfile
from scipy.signal import resample_poly

from livessl.core.types import Float32Array
from livessl.errors import ConfigError
from livessl.recordings.session import SESSION_FILE, SITE_FILE, holds_copied_site, piece, read_session, write_session
from livessl.simulation.of_site import rendered
from livessl.simulation.scene import Scene, truth
from livessl.simulation.unfinished import unfinished_folder
from livessl.site.models import Site

TRUTH_FILE: Final = "truth.jsonl"

NOMINAL_START_NS: Final = 1_767_225_600_000_000_000
"""Start of every simulated session, 2026-01-01T00:00:00Z, so that sessions of the same seed have the same bytes."""


def scene_files(directory: Path, site: Site) -> list[Path]:
    """Return the files that `write_scene` writes, the site file first."""
    recordings = [f"{name}.wav" for name in site.arrays]
    return [directory / name for name in (SITE_FILE, *recordings, TRUTH_FILE, SESSION_FILE)]


def simulated_files(directory: Path) -> frozenset[Path]:
    """Return the files of the simulated session in a folder; none if there is no such session.

    A site file that a person has written is none of them: it has comments, or another layout than a session's copy.
    """
    try:
        session = read_session(directory)
    except ConfigError:
        return frozenset()
    if not (directory / TRUTH_FILE).is_file():
        return frozenset()
    recordings = {piece.file for piece in session.pieces if piece.file == f"{Path(piece.array).name}.wav"}
    found = {directory / name for name in (TRUTH_FILE, SESSION_FILE, *recordings)}
    found |= {directory / SITE_FILE} if holds_copied_site(directory) else set()
    return frozenset(path for path in found if not path.is_symlink())


def write_scene(
    directory: Path,
    site: Site,
    scene: Scene,
    *,
    seed: int,
    rates_hz: Mapping[str, float] | None = None,
    inverted: Mapping[str, Sequence[int]] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render a scene for every array of a site into a folder: `ARRAY.wav` (16 bit), `truth.jsonl`, and a session.

    An earlier simulated session in the folder is replaced as soon as the new one is complete. If rendering fails or is
    interrupted, the earlier session remains unchanged. Files that killed runs have left in the folder are removed.

    Parameters
    ----------
    directory : Path
    site : Site
    scene : Scene
    seed : int
        Seed of the microphones' own noise.
    rates_hz : mapping of array name to float, or None
        Sampling rates of arrays whose files are not written at the scene's rate.
    inverted : mapping of array name to channels, or None
        Channels, counted from 1, whose cables invert the signal: a fault made on purpose.
    progress : callable or None
        Called with (sources done, sources in all).

    Raises
    ------
    OSError
        If the folder cannot be written.
    """
    directory.mkdir(parents=True, exist_ok=True)
    with unfinished_folder(directory, _is_own) as unfinished:
        _write(unfinished, site, scene, seed, rates_hz or {}, inverted or {}, progress)
        _take_place(unfinished, directory)


def _is_own(name: str) -> bool:
    name = name.removesuffix(".part")
    return name in (TRUTH_FILE, SESSION_FILE, SITE_FILE) or name.endswith(".wav")


def _write(
    directory: Path,
    site: Site,
    scene: Scene,
    seed: int,
    rates_hz: Mapping[str, float],
    inverted: Mapping[str, Sequence[int]],
    progress: Callable[[int, int], None] | None,
) -> None:
    pieces = []
    for spec, samples in rendered(site, scene, seed=seed, progress=progress):
        rate_hz = rates_hz.get(spec.name, scene.sample_rate_hz)
        resampled = _resampled(samples, scene.sample_rate_hz, rate_hz)
        signs = np.ones((len(resampled), 1), dtype=np.float32)
        signs[[number - 1 for number in inverted.get(spec.name, ())]] = -1.0
        soundfile.write(directory / f"{spec.name}.wav", (signs * resampled).T, round(rate_hz), subtype="PCM_16")
        pieces.append(piece(spec.name, f"{spec.name}.wav", NOMINAL_START_NS))
    lines = "".join(json.dumps(entry) + "\n" for entry in truth(scene))
    (directory / TRUTH_FILE).write_text(lines, encoding="utf-8")
    write_session(directory, site, pieces)


def _take_place(finished: Path, directory: Path) -> None:
    """Move a finished session into its folder.

    Old recordings are deleted first, and new recordings are moved last, so that a session never has recordings of
    another one. If the process is killed meanwhile, `simulated_files` still recognizes the files in almost all cases.
    """
    before = simulated_files(directory)
    described = [TRUTH_FILE, SESSION_FILE, SITE_FILE]
    for path in before - {directory / name for name in described}:
        path.unlink(missing_ok=True)
    recordings = sorted({path.name for path in finished.iterdir()} - set(described))
    for name in (*described, *recordings):
        (finished / name).replace(directory / name)


def _resampled(samples: Float32Array, from_hz: float, to_hz: float) -> Float32Array:
    if from_hz == to_hz:
        return samples
    ratio = Fraction(round(to_hz), round(from_hz))
    resampled = resample_poly(samples, ratio.numerator, ratio.denominator, axis=1)
    return np.asarray(resampled.clip(-1, 1), dtype=np.float32)
