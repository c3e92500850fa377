"""A simulated scene as a session on disk: a WAV for each array, the truth, and the data for replay."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Final

import soundfile

from livessl.recordings.session import piece, write_session
from livessl.simulation.of_site import rendered
from livessl.simulation.scene import Scene, truth
from livessl.site.models import Site

TRUTH_FILE: Final = "truth.jsonl"

NOMINAL_START_NS: Final = 1_767_225_600_000_000_000
"""Start of every simulated session, 2026-01-01T00:00:00Z, so that sessions of the same seed have the same bytes."""


def write_scene(
    directory: Path,
    site: Site,
    scene: Scene,
    *,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render a scene for every array of a site into a folder: `ARRAY.wav` (16 bit), `truth.jsonl`, and a session.

    Raises
    ------
    OSError
        If the folder cannot be written.
    """
    directory.mkdir(parents=True, exist_ok=True)
    pieces = []
    for spec, samples in rendered(site, scene, seed=seed, progress=progress):
        soundfile.write(directory / f"{spec.name}.wav", samples.T, round(scene.sample_rate_hz), subtype="PCM_16")
        pieces.append(piece(spec.name, f"{spec.name}.wav", NOMINAL_START_NS))
    lines = "".join(json.dumps(entry) + "\n" for entry in truth(scene))
    (directory / TRUTH_FILE).write_text(lines, encoding="utf-8")
    write_session(directory, site, pieces)
