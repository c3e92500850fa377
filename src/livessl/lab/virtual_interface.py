"""Virtual audio interfaces (ALSA, PortAudio) for tests and the demo; faults such as unplugging are made by a file.

The C sources in the folder `interface` beside this file are compiled when they are first needed. A sample is 19 bits of
the interface's own count of samples and 5 bits of its channel, so that the place of each sample is known.
"""

from __future__ import annotations

import atexit
import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes.util import find_library
from dataclasses import dataclass, field
from functools import cache
from itertools import count
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
from numpy.typing import NDArray

from livessl.core.types import Float32Array
from livessl.errors import RunError

COUNTED = 1 << 19
"""The count of samples in a sample starts again after so many."""

_SOURCES = Path(__file__).parent / "interface"
_LIBRARIES = {"pcm.c": "libasound_module_pcm_livessl.so", "system.c": "system.so"}


class NoInterfaceError(RunError):
    """Virtual interfaces cannot be made on this machine."""


def missing() -> str | None:
    """Return in words what this machine lacks for virtual interfaces; None if it lacks nothing."""
    if not sys.platform.startswith("linux"):
        return "virtual interfaces are made of ALSA, which only Linux has"
    if shutil.which("gcc") is None:
        return "there is no C compiler (gcc)"
    if not Path("/usr/include/alsa/asoundlib.h").exists():
        return "ALSA's headers are not installed (libasound2-dev)"
    if find_library("portaudio") is None:
        return "PortAudio is not installed (libportaudio2)"
    return None


@cache
def built() -> Path:
    """Return the folder with the compiled libraries.

    Raises
    ------
    NoInterfaceError
        If they cannot be built here.
    """
    lack = missing()
    if lack is not None:
        raise NoInterfaceError(f"a virtual interface: {lack}; on Debian: apt install gcc libasound2-dev libportaudio2")
    folder = Path(mkdtemp(prefix="livessl-interface-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for source, library in _LIBRARIES.items():
        command = ["gcc", "-O2", "-Wall", "-Werror", "-shared", "-fPIC", "-DPIC", "-o", str(folder / library)]
        libraries = ["-ldl", "-Wl,--no-as-needed", "-lasound"]
        try:
            subprocess.run([*command, str(_SOURCES / source), *libraries], check=True)  # noqa: S603 - our own sources
        except subprocess.CalledProcessError as error:
            raise NoInterfaceError(f"a virtual interface: gcc cannot compile {source}; its message is above") from error
    return folder


@dataclass
class Interface:
    """One virtual interface.

    Parameters
    ----------
    folder : Path
        Its control file and the like.
    card : int
        Its number, as in `hw:CARD,0`.
    name, channels, rates_hz, ppm, serial, usb_port
        What the kernel is given about it.
    """

    folder: Path
    card: int
    name: str = "UMC1820"
    channels: int = 18
    rates_hz: tuple[int, ...] = (44100, 48000, 88200, 96000)
    ppm: float = 0.0
    serial: str = "0001"
    usb_port: str = "usb-0000:00:14.0-1"
    _numbers: Iterator[int] = field(default_factory=lambda: count(1))

    def control(self, word: str) -> None:
        """Set the fault: `gone`, `stall`, `loop`, or `back` for none."""
        new = self.folder / "control.new"
        new.write_text(f"{word}\n")
        new.rename(self.folder / "control")

    def overrun(self) -> None:
        """Make the driver lose samples and report that."""
        self.control(f"xrun {next(self._numbers)}")

    def skip(self, milliseconds: float) -> None:
        """Lose samples without a flag."""
        self.control(f"skip {next(self._numbers)} {milliseconds}")

    def begin(self, monotonic_ns: int) -> None:
        """Have the interface's count of samples, and so the sound that it repeats, begin at a monotonic time."""
        (self.folder / "made").write_text(str(monotonic_ns))

    def play(self, samples: Float32Array) -> None:
        """Deliver samples (channels, n) again and again, from the next opening on."""
        words = np.round(samples.T.astype(np.float64) * (1 << 31)).clip(-(1 << 31), (1 << 31) - 1)
        new = self.folder / "sound.new"
        new.write_bytes(words.astype("<i4").tobytes())
        new.rename(self.folder / "sound")

    @contextmanager
    def held(self) -> Iterator[None]:
        """Record from it with this process, so that it is busy for others."""
        status = self.folder.parent / f"proc/asound/card{self.card}/pcm0c/sub0/status"
        with (self.folder / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            status.write_text(f"state: RUNNING\nowner_pid   : {os.getpid()}\n")
            try:
                yield
            finally:
                status.write_text("closed\n")


class Interfaces:
    """The interfaces of a machine; a program in their `environment` sees no other sound cards.

    Parameters
    ----------
    folder : Path
        An empty folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._all: list[Interface] = []
        libraries = built()
        self.environment = {
            **os.environ,
            "ALSA_CONFIG_PATH": str(folder / "asound.conf"),
            "JACK_NO_START_SERVER": "1",
            "LD_PRELOAD": str(libraries / "system.so"),
            "LIVESSL_INTERFACES": str(folder),
        }
        self._write()

    @property
    def connected(self) -> list[Interface]:
        """The interfaces that are connected."""
        return [each for each in self._all if not _is_gone(each)]

    def add(
        self,
        name: str = "UMC1820",
        channels: int = 18,
        rates_hz: tuple[int, ...] = (44100, 48000, 88200, 96000),
        ppm: float = 0.0,
    ) -> Interface:
        """Connect an interface."""
        card = len(self._all)
        made = Interface(
            self.folder / f"card{card}",
            card,
            name,
            channels,
            rates_hz,
            ppm,
            f"{card + 1:04d}",
            f"usb-0000:00:14.0-{card + 1}",
        )
        made.folder.mkdir()
        (made.folder / "name").write_text(name)
        status = self.folder / f"proc/asound/card{card}/pcm0c/sub0/status"
        status.parent.mkdir(parents=True)
        status.write_text("closed\n")
        # the kernel's `device` is a link to the interface; its parent is the USB device, which has the serial number
        usb = self.folder / f"sys/class/sound/card{card}/usb"
        (usb / "interface").mkdir(parents=True)
        (usb / "serial").write_text(f"{made.serial}\n")
        (usb.parent / "device").symlink_to(usb / "interface")
        self._all.append(made)
        self._write()
        return made

    def unplug(self, interface: Interface) -> None:
        """Disconnect an interface."""
        interface.control("gone")
        self._write()

    def plug(self, interface: Interface) -> None:
        """Connect it again."""
        interface.control("back")
        self._write()

    def _write(self) -> None:
        """Write what the kernel and ALSA say of the interfaces that are connected."""
        there = self.connected
        asound = self.folder / "proc/asound"
        asound.mkdir(parents=True, exist_ok=True)
        (asound / "cards").write_text(
            "".join(
                f"{each.card:2d} [CARD{each.card}          ]: USB-Audio - {each.name}\n"
                f"                      MAKER {each.name} at {each.usb_port}, high speed\n"
                for each in there
            )
        )
        (asound / "pcm").write_text(
            "".join(f"{each.card:02d}-00: USB Audio : USB Audio : capture 1\n" for each in there)
        )
        config = f'pcm_type.livessl {{\n lib "{built() / _LIBRARIES["pcm.c"]}"\n}}\n'
        config += "pcm.default {\n type null\n}\n"  # PortAudio counts on there being a default
        for each in self._all:
            rates = " ".join(map(str, each.rates_hz))
            config += (
                f'pcm.card{each.card} {{\n type livessl\n folder "{each.folder}"\n channels {each.channels}\n'
                f' rates "{rates}"\n ppm {each.ppm:.3f}\n}}\n'
            )
        (self.folder / "asound.conf").write_text(config)


def counts_of(samples: Float32Array) -> NDArray[np.int64]:
    """Return the interface's count of each sample (channels, n).

    Raises
    ------
    AssertionError
        If a sample is not of its channel.
    """
    words = np.round(samples.astype(np.float64) * (1 << 23)).astype(np.int64) & 0xFFFFFF
    assert np.array_equal(words & 31, np.broadcast_to(np.arange(len(samples))[:, None], samples.shape))
    return words >> 5


def _is_gone(interface: Interface) -> bool:
    control = interface.folder / "control"
    return control.exists() and control.read_text().startswith("gone")
