"""Chooses what a node captures: its audio device, or --wav files or a simulated scene in its place."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from livessl.capture.device import Device
from livessl.cli import progress
from livessl.cli.options import wavs
from livessl.clock import Clock
from livessl.errors import ConfigError, Fault, did_you_mean
from livessl.recordings.assign import AssignedRecording
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
        if isinstance(config.device, SoundDeviceConfig):
            given |= {"--start-at": getattr(arguments, "start_at", None), "--loop": getattr(arguments, "loop", None)}
        what = "applies to files, and none is given; remove it or add --wav"
        faults += [Fault(option, what) for option, value in given.items() if value]
    if faults:
        raise ConfigError(faults)


def audio_device(arguments: argparse.Namespace, config: NodeConfig, clock: Clock) -> Device | None:
    """Return the node's audio device; None where files or a scene take its place."""
    if arguments.wav or not isinstance(config.device, SoundDeviceConfig):
        return None
    from livessl.capture.sound_device import SoundDevice

    return SoundDevice(config.device, max(map(max, config.arrays.values())), clock)


def recordings(arguments: argparse.Namespace, site: Site, now_ns: int) -> list[AssignedRecording]:
    """Return the recordings that replace a node's audio device: the files of --wav, or what the site file names."""
    from livessl.capture.playback import node_recordings
    from livessl.recordings.assign import assign_files, common_start_ns, looped

    start_ns = getattr(arguments, "start_at", None) or common_start_ns(now_ns, len(site.nodes))
    if not arguments.wav:
        with progress.counted("simulating the room", "source") as bar:
            parts = node_recordings(site, arguments.node, start_ns, bar)
    else:
        parts = assign_files(site, *wavs(arguments), start_ns)
    return looped(parts) if getattr(arguments, "loop", False) else parts


def run_id(node: str, clock: Clock) -> str:
    """Return a unique name for this run of a node, cut to the 64 characters that the wire format allows."""
    return f"{clock.now_ns()}-{os.getpid()}-{node}"[:64]
