"""`livessl capture` and `serve`: nodes, servers and their ends."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest

from cli.command_runs import Recorded, Run, free_endpoint
from livessl.clock import SystemClock, utc_ns, utc_text
from livessl.server.receiver import Receiver
from small_site import HANG_S, RATE_HZ, running_server, site_of, wait_until, write_site

STOP_S = 5.0
"""Longest time in seconds from Ctrl-C or SIGTERM to the end of a command."""


@pytest.mark.parametrize("command", ["capture", "record"])
def test_unknown_node_is_an_error(run: Run, recorded: Recorded, tmp_path: Path, command: str) -> None:
    out = ["--out", str(tmp_path / "out")] if command == "record" else []
    done = run(command, "--site", recorded.site, "--node", "attic", *out)
    assert done.code == 2
    assert done.err == f"livessl: error: {recorded.site}: nodes: expected one of lab-pc, got --node attic\n"


def test_file_for_an_array_of_another_node_is_an_error(run: Run, recorded: Recorded) -> None:
    done = run("capture", "--site", recorded.site, "--node", "lab-pc", "--wav", "west=w.wav")
    assert done.code == 2
    assert "node 'lab-pc' has the arrays north, south" in done.err


@pytest.mark.parametrize("command", ["capture", "record"])
def test_files_for_only_some_arrays_are_an_error(run: Run, recorded: Recorded, tmp_path: Path, command: str) -> None:
    out = ["--out", tmp_path / "out"] if command == "record" else []
    done = run(command, "--site", recorded.site, "--node", "lab-pc", *recorded.wavs()[:2], *out)
    assert done.code == 2
    assert done.err == "livessl: error: --wav: expected a file for each of north, south; add --wav south=FILE\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("options", [("--start-at", "2026-01-01T00:00:00Z"), ("--loop",), ("--channels", "north=1,2")])
def test_options_of_files_are_refused_for_an_audio_device(
    run: Run, recorded: Recorded, options: tuple[str, ...]
) -> None:
    done = run("capture", "--site", recorded.site, "--node", "lab-pc", *options)
    assert done.code == 2
    assert done.err == (f"livessl: error: {options[0]}: applies to files, and none is given; remove it or add --wav\n")


def test_impossible_scene_of_a_node_is_an_error(run: Run, tmp_path: Path) -> None:
    path = write_site(tmp_path, {"nodes.lab-pc.device": {"type": "scene", "rt60_s": 0.01, "sample_rate_hz": RATE_HZ}})
    done = run("capture", "--site", path, "--node", "lab-pc")
    assert done.code == 2
    assert done.err.startswith("livessl: error: nodes.lab-pc.device: ")
    assert "0.01" in done.err


def test_capture_without_a_server_fails_at_the_end(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    endpoint = free_endpoint()
    site = write_site(tmp_path, {"nodes.lab-pc.server": endpoint})
    begin = utc_text(SystemClock().now_ns() - 10_000_000_000)  # so that the whole recording is due at once
    done = run("capture", "--site", site, "--node", "lab-pc", *recorded.wavs(), "--start-at", begin)
    assert done.code == 1
    assert re.search(
        rf"livessl: error: \d+ messages were never acknowledged by the server at {endpoint}; is one running there\?",
        done.err,
    )


def test_capture_into_a_server_gives_the_events_of_locate(run: Run, recorded: Recorded, tmp_path: Path) -> None:
    with running_server(site_of()) as server:
        site = write_site(tmp_path, {"nodes.lab-pc.server": server.endpoint})
        begin_ns = SystemClock().now_ns() - 10_000_000_000
        begin = utc_text(begin_ns // 50_000_000 * 50_000_000)
        done = run("capture", "--site", site, "--node", "lab-pc", *recorded.wavs(), "--start-at", begin)
        assert done.code == 0
        wait_until(lambda: server.parts.event_log.published == 2, "both events")
        live = httpx.get(f"{server.url}/api/v1/events").json()["events"][::-1]
    located = run("locate", "--site", recorded.site, *recorded.wavs(), "--json").objects
    assert [event["position_m"] for event in live] == [event["position_m"] for event in located]
    after_s = [(utc_ns(event["time_utc"]) - utc_ns(begin)) / 1e9 for event in live]
    assert after_s == pytest.approx([event["start_s"] for event in located], abs=1e-6)


def test_ports_in_use_are_an_error(run: Run, tmp_path: Path) -> None:
    receiver = Receiver(site_of(), SystemClock())
    done = run("serve", "--site", write_site(tmp_path, {"server.bind": receiver.endpoint}))
    receiver.stop()
    assert done.code == 1
    assert f"error: server.bind: cannot listen on {receiver.endpoint}: Address already in use" in done.err
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        probe.listen()
        port = probe.getsockname()[1]
        done = run("serve", "--site", write_site(tmp_path, {"server.http.port": port}))
    assert done.code == 1
    assert f"error: server.http: cannot listen on 127.0.0.1:{port}: Address already in use" in done.err


def test_unusable_database_is_an_error(run: Run, tmp_path: Path) -> None:
    done = run("serve", "--site", write_site(tmp_path, {"server.events_db": str(tmp_path)}))
    assert done.code == 1
    assert "error: server.events_db: cannot use" in done.err


class Process:
    """A command that runs as a process of its own."""

    def __init__(self, directory: Path, *arguments: object) -> None:
        self._log = directory / f"{arguments[0]}-{id(self)}.log"
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "livessl", *map(str, arguments)], stdout=log, stderr=subprocess.STDOUT
            )

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()

    @property
    def output(self) -> str:
        return self._log.read_text(encoding="utf-8")

    def wait_for(self, pattern: str) -> re.Match[str]:
        def found() -> re.Match[str] | None:
            assert self.process.poll() is None, self.output
            return re.search(pattern, self.output)

        wait_until(found, f"{pattern} in its output")
        match = found()
        assert match is not None
        return match

    def end(self, number: signal.Signals) -> tuple[int, float]:
        """Send a signal; return the exit code, and the seconds until the process ended."""
        began = time.monotonic()
        self.process.send_signal(number)
        code = self.process.wait(timeout=HANG_S)
        return code, time.monotonic() - began


@pytest.mark.processes
def test_ctrl_c_and_sigterm_stop_servers_and_nodes_cleanly(recorded: Recorded, tmp_path: Path) -> None:
    endpoint = free_endpoint()
    site = write_site(
        tmp_path,
        {
            "server.bind": endpoint,
            "nodes": {
                f"{name}-pc": {
                    "server": endpoint,
                    "device": {"type": "wav", "files": {name: str(recorded.directory / f"{name}.wav")}, "loop": True},
                    "arrays": {name: [1, 2, 3, 4]},
                }
                for name in ("north", "south")
            },
        },
    )
    other = tmp_path / "other"
    other.mkdir()
    starts = {"north": SystemClock().now_ns(), "south": SystemClock().now_ns() + 3_600_000_000_000}
    with ExitStack() as stack:

        def command(*arguments: object) -> Process:
            return stack.enter_context(Process(tmp_path, *arguments))

        servers = [command("serve", "--site", site), command("serve", "--site", write_site(other))]
        nodes = [
            command("capture", "--site", site, "--node", f"{name}-pc", "--start-at", utc_text(start_ns))
            for name, start_ns in starts.items()  # one plays, and the other waits for its start
        ]
        urls = [server.wait_for(r"dashboard on (http://\S+)")[1] for server in servers]
        for node in nodes:
            node.wait_for("connected to the server")
        for url in urls:
            assert httpx.get(f"{url}/api/v1/health", timeout=HANG_S).status_code == 200
        numbers = (signal.SIGTERM, signal.SIGINT)
        ends = [process.end(number) for process, number in zip(nodes, numbers, strict=True)]
        servers[0].wait_for("node 'north-pc' has ended")
        ends += [process.end(number) for process, number in zip(servers, numbers, strict=True)]
        for (code, seconds), process in zip(ends, (*nodes, *servers), strict=True):
            assert code == 0, process.output
            assert seconds < STOP_S
            assert "Traceback" not in process.output
