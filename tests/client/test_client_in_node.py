"""The JavaScript client in Node.js, whose WebSocket differs from that of browsers, or is missing."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from conftest import require
from small_site import HANG_S

CLIENT = Path(__file__).parents[2] / "src" / "livessl" / "server" / "static" / "client.js"

ENDS_AFTER_THREE = """
let downs = 0;
const stop = follow("http://127.0.0.1:9", {
  onMessage() {},
  onState(state) {
    console.log(state);
    if (++downs === 3) stop();
  },
});
"""

REPORTS = {"an error only": "this.onerror({})", "both": "this.onerror({}), this.onclose({ code: 1006 })"}


def run(tmp_path: Path, before: str, program: str) -> subprocess.CompletedProcess[str]:
    node = shutil.which("node")
    require(node is not None, "Node.js is not installed (Debian: apt install nodejs)")
    assert node is not None
    shutil.copy(CLIENT, tmp_path / "client.mjs")
    path = tmp_path / "program.mjs"
    path.write_text(f'import {{ follow }} from "./client.mjs";\n{before}\n{program}', encoding="utf-8")
    return subprocess.run([node, str(path)], capture_output=True, text=True, timeout=HANG_S, check=False)


@pytest.mark.parametrize("reports", REPORTS)
def test_connection_is_tried_again_whatever_a_failed_one_reports(tmp_path: Path, reports: str) -> None:
    fake = f"""globalThis.WebSocket = class {{
      constructor() {{ setTimeout(() => {{ {REPORTS[reports]}; }}, 1); }}
      close() {{}}
    }};"""
    done = run(tmp_path, fake, ENDS_AFTER_THREE)
    assert (done.returncode, done.stdout.split()) == (0, ["down"] * 3), done.stderr


def test_node_without_a_websocket_is_named(tmp_path: Path) -> None:
    done = run(tmp_path, "delete globalThis.WebSocket;", ENDS_AFTER_THREE)
    assert done.returncode == 1
    assert "expected a browser or Node.js 22 or newer" in done.stderr
