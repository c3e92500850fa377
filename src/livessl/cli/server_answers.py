"""Requests of commands to a running server (--url, --token-file), and what is said when none answers or it refuses."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from http.client import HTTPException
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from livessl.client.address import check_url, open_url, reason_of, redirection
from livessl.errors import RunError, UseError

if TYPE_CHECKING:
    from pydantic import BaseModel

M = TypeVar("M", bound="BaseModel")

ANSWER_S: Final = 10.0
"""Longest wait for a server's answer, seconds."""


class RefusedError(RunError):
    """A server has refused a request.

    Parameters
    ----------
    text : str
        What it said, with the address.
    status : int
        Status of its answer.
    reason : str
        Its own words; empty if it gave none.
    """

    def __init__(self, text: str, status: int, reason: str) -> None:
        super().__init__(text)
        self.status = status
        self.reason = reason


def add_server(parser: Any, text: str) -> None:
    """Add --url and --token-file."""
    parser.add_argument("--url", help=f"address of a running server, such as http://127.0.0.1:8000; {text}")
    add_token_file(parser)


def add_token_file(parser: Any) -> None:
    """Add --token-file."""
    parser.add_argument(
        "--token-file",
        type=Path,
        metavar="FILE",
        help="file that holds an access token for the server, if it requires one",
    )


def read_token(token_file: Path) -> str:
    """Return the token in a file.

    Raises
    ------
    UseError
        If the file cannot be read, or holds no token.
    """
    try:
        token = token_file.read_text(encoding="utf-8").strip()
    except OSError as error:
        raise UseError(f"--token-file: cannot read {token_file}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UseError(f"--token-file: expected a token in {token_file}, got bytes that are no text") from error
    if not (token and token.isascii() and token.isprintable()):
        raise UseError(
            f"--token-file: expected the line that `livessl keys token` printed in {token_file}, got another"
        )
    return token


def ask(url: str, path: str, token_file: Path | None) -> Any:
    """Return a server's answer to `GET /api/v1/PATH`, which is JSON: see `fetch`; any JSON will do."""
    address = _address(url, path)
    body = fetch(address, token_file)
    try:
        return json.loads(body)
    except (ValueError, RecursionError) as error:
        raise RunError(f"{address}: the answer is not JSON ({error}); check the address") from error


def ask_for(model: type[M], url: str, path: str, token_file: Path | None) -> M:
    """Return a server's answer to `GET /api/v1/PATH`.

    Raises
    ------
    UseError
        If `fetch` raises it.
    RunError
        If `fetch` raises it, or the answer is not what `model` describes.
    """
    from livessl.client.reading import read_answer

    address = _address(url, path)
    return read_answer(model, fetch(address, token_file), address)


def fetch(address: str, token_file: Path | None) -> bytes:
    """Return the body of a server's answer to `GET`.

    Raises
    ------
    UseError
        If the address or the token's file cannot be used.
    RefusedError
        If the server refuses; with its reason.
    RunError
        If it does not answer.
    """
    return _answer(address, token_file, None, ANSWER_S)


def order(model: type[M], url: str, path: str, token_file: Path | None, value: Any, wait_s: float = ANSWER_S) -> M:
    """Return a server's answer to `POST /api/v1/PATH` with a value as JSON.

    Parameters
    ----------
    model : type
        Model of the answer.
    url, path : str
    token_file : Path or None
        File that holds a token.
    value : Any
    wait_s : float
        Longest wait for the answer, seconds.

    Raises
    ------
    UseError, RunError
        See `ask_for`.
    """
    from livessl.client.reading import read_answer

    address = _address(url, path)
    return read_answer(model, _answer(address, token_file, json.dumps(value).encode(), wait_s), address)


def check_address(url: str) -> None:
    """Raise `UseError` unless --url names a server."""
    try:
        check_url(url)
    except UseError as error:
        raise UseError(f"--{error}") from error


def _address(url: str, path: str) -> str:
    check_address(url)
    return f"{url.rstrip('/')}/api/v1/{path}"


def _answer(address: str, token_file: Path | None, body: bytes | None, wait_s: float) -> bytes:
    headers = {} if body is None else {"Content-Type": "application/json"}
    if token_file is not None:
        headers["Authorization"] = f"Bearer {read_token(token_file)}"
    request = urllib.request.Request(address, body, headers)  # noqa: S310 - the address begins with http
    try:
        with open_url(request, wait_s) as response:
            answer: bytes = response.read()
            return answer
    except urllib.error.HTTPError as error:
        reason = reason_of(error)
        said = redirection(error) or (reason and f": {reason}")
        cure = "; give --token-file" if error.code in (401, 403) and token_file is None else ""
        if error.code in (404, 405, 501) and not said:  # a livessl server gives a reason
            cure = "; what answers there is no livessl server, so check the address"
        text = f"{address}: the server answered {error.code} {error.reason}{said}{cure}"
        raise RefusedError(text, error.code, reason) from error
    except (OSError, ValueError, HTTPException) as error:
        why = getattr(error, "reason", error)
        raise RunError(f"{address}: no answer from a server ({why}); check that it runs and its address") from error
