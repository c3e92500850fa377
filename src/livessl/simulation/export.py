"""A simulated scene as a session on disk: a WAV for each array, the truth, and the data for replay."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
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

    A site file that somebody has written is none of them: it has comments, or another layout than a session's copy.
    """
    try:
        session = read_session(directory)
    except ConfigError:
        return frozenset()
    if not (directory / TRUTH_FILE).is_file():
        return frozenset()
    found = {directory / TRUTH_FILE, directory / SESSION_FILE, *map(session.path, session.pieces)}
    found |= {directory / SITE_FILE} if holds_copied_site(directory) else set()
    return frozenset(path for path in found if not path.is_symlink())


def write_scene(
    directory: Path,
    site: Site,
    scene: Scene,
    *,
    seed: int,
    rates_hz: Mapping[str, float] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render a scene for every array of a site into a folder: `ARRAY.wav` (16 bit), `truth.jsonl`, and a session.

    Parameters
    ----------
    directory : Path
    site : Site
    scene : Scene
    seed : int
        Seed of the microphones' own noise.
    rates_hz : mapping of array name to float, or None
        Sampling rates of arrays whose files are not written at the scene's rate.
    progress : callable or None
        Called with (sources done, sources in all).

    Raises
    ------
    OSError
        If the folder cannot be written.
    """
    directory.mkdir(parents=True, exist_ok=True)
    pieces = []
    for spec, samples in rendered(site, scene, seed=seed, progress=progress):
        rate_hz = (rates_hz or {}).get(spec.name, scene.sample_rate_hz)
        resampled = _resampled(samples, scene.sample_rate_hz, rate_hz)
        soundfile.write(directory / f"{spec.name}.wav", resampled.T, round(rate_hz), subtype="PCM_16")
        pieces.append(piece(spec.name, f"{spec.name}.wav", NOMINAL_START_NS))
    lines = "".join(json.dumps(entry) + "\n" for entry in truth(scene))
    (directory / TRUTH_FILE).write_text(lines, encoding="utf-8")
    write_session(directory, site, pieces)


def _resampled(samples: Float32Array, from_hz: float, to_hz: float) -> Float32Array:
    if from_hz == to_hz:
        return samples
    ratio = Fraction(round(to_hz), round(from_hz))
    resampled = resample_poly(samples, ratio.numerator, ratio.denominator, axis=1)
    return np.asarray(resampled.clip(-1, 1), dtype=np.float32)
