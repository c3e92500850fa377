"""Clients that common tools generate from the descriptions are typed and read what the server sends."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx
import jsonschema_rs
import pytest
from websockets.sync.client import connect

from conftest import require
from livessl.capture.node import send_session
from livessl.clock import SystemClock, UnpacedClock
from livessl.server.api.app import STATIC
from livessl.server.app import Server
from small_site import HANG_S, running_server, scene_recordings, site_of

PACKAGES = {"openapi-typescript": "7.13.0", "typescript": "5.9.3", "@asyncapi/specs": "6.11.1"}
"""Packages from npm, at fixed versions, so that a new release cannot break the tests."""

TYPESCRIPT_CLIENT = """\
import type { components, paths } from "./api";

type Page = paths["/api/v1/events"]["get"]["responses"][200]["content"]["application/json"];

export async function positions(url: string): Promise<number[][]> {
  const page: Page = await (await fetch(`${url}/api/v1/events?limit=3`)).json();
  const located = page.events.filter((event) => event.status === "located");
  // @ts-expect-error: no event has such a status
  page.events.filter((event) => event.status === "lost");
  // @ts-expect-error: no event has such a field
  page.events.map((event) => event.colour);
  const event: components["schemas"]["Event"] | undefined = located[0];
  const started: string | null = event?.time_utc ?? null;
  console.log(started, page.next_cursor);
  return located.map((event) => event.position_m ?? []);
}
"""


FOLLOWER = """\
import { follow, type LiveEvent } from "./follow";

const events: LiveEvent[] = [];
const stop: () => void = follow("http://127.0.0.1:8000", {
  kinds: ["event", "alert"],
  zone: "door",
  onMessage: (message) => {
    if (message.kind === "event") events.push(message);
    else if (message.kind === "gap") console.log(message.missed);
    // @ts-expect-error: not every message has a position
    message.position_m.length;
  },
});
// @ts-expect-error: there is no such kind
follow("http://127.0.0.1:8000", { kinds: ["smell"], onMessage: () => {} });
stop();
"""


@pytest.fixture(scope="module")
def live_messages(server_and_messages: tuple[Server, list[str]]) -> list[str]:
    return server_and_messages[1]


@pytest.fixture(scope="module")
def server(server_and_messages: tuple[Server, list[str]]) -> Server:
    return server_and_messages[0]


@pytest.fixture(scope="module")
def server_and_messages() -> Iterator[tuple[Server, list[str]]]:
    """A server that has located two events, and the messages that it sent meanwhile."""
    with running_server(site_of()) as server:
        with connect(f"ws{server.url.removeprefix('http')}/api/v1/live", open_timeout=HANG_S) as socket:
            start_ns = SystemClock().now_ns()
            send_session(
                site_of(),
                server.endpoint,
                scene_recordings(start_ns),
                UnpacedClock(),
                SystemClock(),
                "run",
                lambda: False,
            )
            server.wait_idle()
            messages, events = [], 0
            while events < 2:
                messages.append(str(socket.recv(timeout=HANG_S)))
                events += json.loads(messages[-1])["kind"] == "event"
        yield server, messages


@pytest.fixture(scope="module")
def npm(request: pytest.FixtureRequest) -> Path:
    """Folder in pytest's cache with `node_modules`, installed once."""
    program = shutil.which("npm")
    require(program is not None, "npm is not installed (Debian: apt install nodejs npm)")
    assert program is not None
    folder: Path = request.config.cache.mkdir("npm")
    wanted = json.dumps({"private": True, "dependencies": PACKAGES})
    package = folder / "package.json"
    if not (folder / "installed").exists() or package.read_text(encoding="utf-8") != wanted:
        package.write_text(wanted, encoding="utf-8")
        done = _run(program, "install", "--no-audit", "--no-fund", "--ignore-scripts", cwd=folder, check=False)
        require(done.returncode == 0, f"npm cannot install {', '.join(PACKAGES)}: {done.stderr.strip()[-300:]}")
        (folder / "installed").touch()
    return folder


def _run(*command: str | Path, cwd: Path, check: bool = True) -> subprocess.CompletedProcess[str]:
    paths = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    done = subprocess.run(
        command, cwd=cwd, capture_output=True, text=True, timeout=100, check=False, env={**os.environ, "PATH": paths}
    )
    assert done.returncode == 0 or not check, done.stdout + done.stderr
    return done


def _save(server: Server, name: str, folder: Path) -> Path:
    path = folder / name
    path.write_bytes(httpx.get(f"{server.url}/api/v1/{name}").content)
    return path


def test_python_client_returns_typed_events(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    description = _save(server, "openapi.json", tmp_path)
    config = tmp_path / "config.json"  # as docs/api.md says
    binary = dict.fromkeys(("audio/flac", "audio/wav", "image/png"), "application/octet-stream")
    config.write_text(json.dumps({"content_type_overrides": binary}))
    done = _run(
        *(sys.executable, "-m", "openapi_python_client", "generate", "--fail-on-warning", "--config", config),
        *("--path", description, "--meta", "none", "--output-path", tmp_path / "generated_client"),
        cwd=tmp_path,
    )
    assert "warning" not in done.stdout.lower(), done.stdout
    monkeypatch.syspath_prepend(tmp_path)
    client: Any = importlib.import_module("generated_client")
    models: Any = importlib.import_module("generated_client.models")
    get_events: Any = importlib.import_module("generated_client.api.estimates.get_events_api_v1_events_get")
    with client.Client(base_url=server.url, raise_on_unexpected_status=True) as connection:
        page = get_events.sync(client=connection, limit=2)
        assert isinstance(page, models.EventPage)
        assert len(page.events) == 2
        for event in page.events:
            assert isinstance(event, models.Event)
            assert isinstance(event.time_utc, datetime)
            assert event.status is models.Status.LOCATED
            assert all(isinstance(part, models.Contribution) for part in event.contributions)
        newest = page.events[0]
        again = get_events.sync(client=connection, since=newest.time_utc)
        assert [event.id for event in again.events] == [newest.id]
        missing = get_events.sync(client=connection, zone="hall")
        assert isinstance(missing, models.Error)


def test_typescript_client_compiles(server: Server, npm: Path, tmp_path: Path) -> None:
    """The lines that expect an error show that the types are not simply `any`."""
    description = _save(server, "openapi.json", tmp_path)
    programs = npm / "node_modules" / ".bin"
    _run(programs / "openapi-typescript", description, "--output", tmp_path / "api.d.ts", cwd=tmp_path)
    (tmp_path / "client.ts").write_text(TYPESCRIPT_CLIENT, encoding="utf-8")
    (tmp_path / "follow.d.ts").write_bytes((STATIC / "client.d.ts").read_bytes())
    (tmp_path / "follower.ts").write_text(FOLLOWER, encoding="utf-8")
    options = ("--noEmit", "--strict", "--target", "es2022", "--lib", "es2022,dom")
    _run(programs / "tsc", *options, "client.ts", "follower.ts", cwd=tmp_path)


def test_message_classes_read_real_messages(
    server: Server, live_messages: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    description = _save(server, "asyncapi.json", tmp_path)
    _run(
        *(sys.executable, "-m", "datamodel_code_generator", "--input", description, "--input-file-type", "asyncapi"),
        *("--output", tmp_path / "generated_messages.py", "--output-model-type", "pydantic_v2.BaseModel"),
        cwd=tmp_path,
    )
    monkeypatch.syspath_prepend(tmp_path)
    generated: Any = importlib.import_module("generated_messages")
    classes = {
        kind: getattr(generated, "Hello" if kind == "hello" else f"{kind.title()}Message")
        for kind in ("hello", "event", "update", "track", "arrays")
    }
    read = set()
    for text in live_messages:
        kind = json.loads(text)["kind"]
        message = classes[kind].model_validate_json(text)
        assert message.seq > 0
        read.add(kind)
    assert read >= {"hello", "event", "update", "arrays"}


def test_asyncapi_document_is_valid(server: Server, npm: Path, tmp_path: Path) -> None:
    described = json.loads(_save(server, "asyncapi.json", tmp_path).read_text(encoding="utf-8"))
    schemas = npm / "node_modules" / "@asyncapi" / "specs" / "schemas"
    schema = json.loads((schemas / "3.0.0-without-$id.json").read_text(encoding="utf-8"))
    validator = jsonschema_rs.Draft7Validator(schema)
    validator.validate(described)
    described["channels"]["live"]["messages"]["Hello"] = "hello"
    assert not validator.is_valid(described)
