"""The nginx example of docs/reverse-proxy.md, run with a real nginx on free ports."""

from __future__ import annotations

import re
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from conftest import require
from livessl.lab.processes import free_port
from small_site import started, wait_until

NGINX: Final = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")
PAGE: Final = Path(__file__).parents[1] / "docs" / "reverse-proxy.md"

_MAIN: Final = """\
daemon off;
worker_processes 1;
pid {folder}/nginx.pid;
error_log {folder}/error.log;
events {{ worker_connections 64; }}
http {{
  access_log off;
  proxy_max_temp_file_size 0;
  client_body_temp_path {folder}/body;
  proxy_temp_path {folder}/proxy;
  fastcgi_temp_path {folder}/fastcgi;
  uwsgi_temp_path {folder}/uwsgi;
  scgi_temp_path {folder}/scgi;
{server}
}}
"""


def example(location: str) -> str:
    """The block of the documented nginx example whose location this is."""
    blocks: list[str] = re.findall(r"^```nginx\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)
    [block] = [block for block in blocks if f"location {location} {{" in block]
    return block


@contextmanager
def running_nginx(folder: Path, server: str) -> Iterator[str]:
    """Run nginx with one server block on a free port instead of its own; yields its URL."""
    require(NGINX is not None, "nginx is not installed (Debian: apt install nginx-light)")
    assert NGINX is not None
    port = free_port()
    configuration = folder / "nginx.conf"
    block = server.replace("listen 80;", f"listen 127.0.0.1:{port};")
    configuration.write_text(_MAIN.format(folder=folder, server=block), encoding="utf-8")
    with started(NGINX, "-p", folder, "-e", folder / "error.log", "-c", configuration) as process:

        def answers() -> bool:
            log = folder / "error.log"
            assert process.poll() is None, log.read_text(encoding="utf-8") if log.exists() else "nginx has ended"
            with socket.socket() as probe:
                return probe.connect_ex(("127.0.0.1", port)) == 0

        wait_until(answers, "nginx")
        yield f"http://127.0.0.1:{port}"
