"""A virtual sound card behind a sound server, a private PulseAudio: what is played into it can be recorded."""

from __future__ import annotations

import os
import subprocess
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from small_site import HANG_S, wait_until

RATE_HZ = 48000


class VirtualCard:
    """A virtual sound card of four channels, a private PulseAudio: sound that is played into it can be recorded."""

    CHANNELS = "front-left,front-right,rear-left,rear-right"
    """Channel map in ALSA's order of four channels, so that no layer remixes them."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        socket = directory / "native"
        alsa = directory / "asound.conf"
        alsa.write_text(
            'pcm.virtual {\n type pulse\n device "virtual.monitor"\n}\n'
            "pcm.default {\n type null\n}\n"  # PortAudio counts on there being a default
        )
        directory.chmod(0o700)
        self.environment = {
            **os.environ,
            "HOME": str(directory),
            "XDG_RUNTIME_DIR": str(directory),
            "XDG_CONFIG_HOME": str(directory),
            "PULSE_RUNTIME_PATH": str(directory),
            "PULSE_SERVER": f"unix:{socket}",
            "ALSA_CONFIG_PATH": str(alsa),
            "JACK_NO_START_SERVER": "1",
        }
        self.socket = socket
        self.running: list[subprocess.Popen[str]] = []
        self.server: subprocess.Popen[str] | None = None

    def plug_in(self) -> None:
        """Start the card, and wait until it answers."""
        self.server = self.start(
            "pulseaudio",
            "--daemonize=no",
            "--use-pid-file=no",
            "--exit-idle-time=-1",
            "--log-target=null",
            "-n",
            f"--load=module-native-protocol-unix auth-anonymous=1 socket={self.socket}",
            f"--load=module-null-sink sink_name=virtual channels=4 rate={RATE_HZ} channel_map={self.CHANNELS}",
        )
        server = self.server
        wait_until(lambda: server.poll() is not None or self._sinks() == ["virtual"], "pulseaudio's answer")
        assert server.poll() is None, f"pulseaudio has exited with {server.returncode}"

    def _sinks(self) -> list[str]:
        listed = subprocess.run(
            ["pactl", "list", "short", "sinks"], env=self.environment, capture_output=True, text=True, check=False
        )
        return [line.split("\t")[1] for line in listed.stdout.splitlines()]

    def pull_out(self) -> None:
        """Stop the card."""
        assert self.server is not None
        self.server.terminate()
        self.server.wait()

    def play(self, samples: NDArray[np.float32]) -> None:
        """Begin to play (n, 4) samples."""
        path = self.directory / "signal.raw"
        path.write_bytes(samples.astype("<f4").tobytes())
        self.start(
            "pacat",
            "--playback",
            "--raw",
            "--device=virtual",
            "--format=float32le",
            "--channels=4",
            f"--rate={RATE_HZ}",
            f"--channel-map={self.CHANNELS}",
            str(path),
        )

    def start(self, *command: str) -> subprocess.Popen[str]:
        """Start a program that sees only this card; it ends with the test."""
        process = subprocess.Popen(
            command, env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        self.running.append(process)
        return process

    def close(self) -> None:
        """End everything."""
        for process in reversed(self.running):
            process.terminate()
        for process in self.running:
            with suppress(subprocess.TimeoutExpired):
                process.wait(timeout=HANG_S)
            process.kill()
            process.communicate()
