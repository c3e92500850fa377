"""Chooses what a node captures: its audio device, or --wav files, a session or a simulated scene in its place."""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

from livessl.capture.device import Device
from livessl.cli import progress
from livessl.cli.options import wavs
from livessl.clock import Clock
from livessl.core.types import FRAME_NS
from livessl.errors import ConfigError, Fault, UseError, did_you_mean
from livessl.recordings.assign import AssignedRecording, assign_files, assign_sessions, common_start_ns, looped
from livessl.recordings.session import read_session
from livessl.site.models import Site
from livessl.site.node_models import NodeConfig, SoundDeviceConfig


def node_config(site: Site, name: str, path: Path) -> NodeConfig:
    """Return the configuration of one node of a site.

    Raises
    ------
    ConfigError
        If the site has no node of that name.
    """
    if name not in site.nodes:
        known = ", ".join(site.nodes) or "none"
        raise ConfigError(
            [Fault(f"{path}: nodes", f"expected one of {known}, got --node {name}{did_you_mean(name, site.nodes)}")]
        )
    return site.nodes[name]


def check_files(arguments: argparse.Namespace, config: NodeConfig) -> None:
    """Check that files are given for all arrays of a node or for none, and file options only with files.

    Raises
    ------
    ConfigError
        With every fault.
    """
    files, _ = wavs(arguments)
    known, faults = ", ".join(config.arrays), []
    session = getattr(arguments, "session", None)
    if files and session is not None:
        raise UseError(f"{arguments.command}: expected --wav or --session, got both; remove one of them")
    if files:
        strangers = [name for name in files if name not in config.arrays]
        missing = [name for name in config.arrays if name not in files]
        faults += [
            Fault(
                f"--wav {name}=…", f"node {arguments.node!r} has the arrays {known}{did_you_mean(name, config.arrays)}"
            )
            for name in strangers
        ]
        faults += [Fault("--wav", f"expected a file for each of {known}; add --wav {name}=FILE") for name in missing]
    else:
        given = {"--channels": arguments.channels}
        if isinstance(config.device, SoundDeviceConfig) and session is None:
            given |= {"--start-at": getattr(arguments, "start_at", None), "--loop": getattr(arguments, "loop", None)}
        what = "applies to files, and none is given; remove it or add --wav"
        faults += [Fault(option, what) for option, value in given.items() if value]
    if faults:
        raise ConfigError(faults)


def audio_device(arguments: argparse.Namespace, config: NodeConfig, clock: Clock) -> Device | None:
    """Return the node's audio device; None where files or a scene take its place."""
    if arguments.wav or getattr(arguments, "session", None) or not isinstance(config.device, SoundDeviceConfig):
        return None
    from livessl.capture.sound_device import SoundDevice

    return SoundDevice(config.device, max(map(max, config.arrays.values())), clock)


def recordings(arguments: argparse.Namespace, site: Site, now_ns: int) -> list[AssignedRecording]:
    """Return the recordings that replace a node's audio device: --wav, --session, or what the site file names."""
    from livessl.capture.playback import node_recordings

    start_ns = getattr(arguments, "start_at", None) or common_start_ns(now_ns, len(site.nodes))
    session = getattr(arguments, "session", None)
    if session is not None:
        parts = _of_session(site, arguments.node, session, start_ns)
    elif not arguments.wav:
        with progress.counted("simulating the room", "source") as bar:
            parts = node_recordings(site, arguments.node, start_ns, bar)
    else:
        parts = assign_files(site, *wavs(arguments), start_ns)
    return looped(parts) if getattr(arguments, "loop", False) else parts


def _of_session(site: Site, node: str, directory: Path, start_ns: int) -> list[AssignedRecording]:
    """Return the recordings of a session for a node's arrays, as if the session had begun at `start_ns`.

    They begin up to a frame later, so that frames are cut as they were when the session was recorded.

    Raises
    ------
    ConfigError
        If the folder holds no session, or the session has no recording of one of the arrays.
    """
    session = read_session(directory)
    own = tuple(piece for piece in session.pieces if piece.array in site.nodes[node].arrays)
    recorded = {piece.array for piece in own}
    missing = [name for name in site.nodes[node].arrays if name not in recorded]
    if missing:
        there = ", ".join(dict.fromkeys(piece.array for piece in session.pieces))
        what = f"expected a recording of {missing[0]!r}, an array of node {node!r}, got {there}; give another session"
        raise ConfigError([Fault(f"--session {directory}", what)])
    later_ns = start_ns - min(piece.start_ns for piece in session.pieces)
    later_ns = -(-later_ns // FRAME_NS) * FRAME_NS
    parts = assign_sessions(site, [replace(session, pieces=own)])
    return [replace(part, start_ns=part.start_ns + later_ns) for part in parts]


def run_id(node: str, clock: Clock) -> str:
    """Return a unique name for this run of a node, cut to the 64 characters that the wire format allows."""
    return f"{clock.now_ns()}-{os.getpid()}-{node}"[:64]
