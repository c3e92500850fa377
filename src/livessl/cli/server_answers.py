"""Answers of a running server to commands, and what is said when there is none."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any, Final

from livessl.errors import RunError, UseError

ANSWER_S: Final = 10.0
"""Longest wait for a server's answer, seconds."""


def add_server(parser: Any, text: str) -> None:
    """Add --url and --token-file."""
    parser.add_argument("--url", help=f"address of a running server, such as http://127.0.0.1:8000; {text}")
    parser.add_argument(
        "--token-file", type=Path, metavar="FILE", help="file with an access token, if the server requires one"
    )


def ask(url: str, path: str, token_file: Path | None) -> Any:
    """Return a server's answer to `GET /api/v1/PATH`.

    Raises
    ------
    UseError
        If the address or the token's file cannot be used.
    RunError
        If the server does not answer, or refuses.
    """
    address = f"{url.rstrip('/')}/api/v1/{path}"
    if not address.startswith(("http://", "https://")):
        raise UseError(f"--url: expected an address such as http://127.0.0.1:8000, got {url!r}")
    headers = {}
    if token_file is not None:
        try:
            headers["Authorization"] = f"Bearer {token_file.read_text(encoding='utf-8').strip()}"
        except OSError as error:
            raise UseError(f"--token-file: cannot read {token_file}: {error.strerror}") from error
    request = urllib.request.Request(address, headers=headers)  # noqa: S310 - the address begins with http
    try:
        with urllib.request.urlopen(request, timeout=ANSWER_S) as response:  # noqa: S310
            return json.load(response)
    except urllib.error.HTTPError as error:
        cure = "; give --token-file" if error.code in (401, 403) and token_file is None else ""
        raise RunError(f"{address}: the server answered {error.code} {error.reason}{cure}") from error
    except (OSError, ValueError) as error:
        why = getattr(error, "reason", error)
        raise RunError(f"{address}: no answer from a server ({why}); check that it runs and its address") from error
