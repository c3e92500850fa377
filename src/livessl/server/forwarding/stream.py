"""Names in NATS (subjects, stream, consumer, message ids), and how sites and hubs connect to it."""

from __future__ import annotations

import asyncio
import secrets
import ssl
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from contextlib import asynccontextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from livessl.errors import ConfigError, Fault
from livessl.site.hub_models import NatsConfig
from livessl.site.secret_files import read_secret

if TYPE_CHECKING:
    from nats.aio.client import Client

STREAM: Final = "LIVESSL"
"""Name of the stream, which a hub makes."""

CONSUMER: Final = "hub"
"""Name of the durable consumer, which all hubs share."""

KINDS: Final = ("start", "event", "track", "array", "alert")
"""Kinds of messages in the stream; the last part of their subjects. `start` reports that a site's server has begun."""

HEALTH: Final = "health"
"""Last part of the subject of a site's report on itself, which is not kept: only the newest counts."""

MESSAGE_ID: Final = "Nats-Msg-Id"
"""Header by which JetStream recognizes a message that it has already."""

CONNECT_S: Final = 2
"""Longest time, in seconds, of an attempt to connect."""

RECONNECT_S: Final = 0.25
"""Wait, in seconds, before another attempt to connect."""

CLOSE_S: Final = 1.0
"""Longest time, in seconds, that the end of a connection may take."""

CANCEL_S: Final = 0.1
"""Wait, in seconds, before a task that goes on is cancelled again."""

PING_S: Final = 5
"""Interval, in seconds, of the pings by which a dead connection is noticed, after two that are not answered."""

_PREFIX: Final = "livessl"


class Place(NamedTuple):
    """A message's place: the name of the outbox that it comes from, and its number there."""

    outbox: str
    number: int


def subject(site: str, kind: str) -> str:
    """Return the subject of a site's messages of one kind."""
    return f"{_PREFIX}.{_token(site)}.{kind}"


def parse_subject(text: str) -> tuple[str, str] | None:
    """Return the site and the kind of a subject; None if it is not one of ours."""
    parts = text.split(".")
    if len(parts) != 3 or parts[0] != _PREFIX:
        return None
    return parts[1].replace("%2E", "."), parts[2]


def subjects_of_stream() -> list[str]:
    """Return the subjects that the stream keeps."""
    return [f"{_PREFIX}.*.{kind}" for kind in KINDS]


def health_of_all() -> str:
    """Return the subject under which all sites report on themselves."""
    return f"{_PREFIX}.*.{HEALTH}"


def message_id(place: Place) -> str:
    """Return the id by which JetStream recognizes a message that it has already."""
    return f"{place.outbox}-{place.number}"


def parse_message_id(text: str | None) -> Place | None:
    """Return the place that a message id stands for; None if it is not one of ours."""
    name, _, number = (text or "").rpartition("-")
    return Place(name, int(number)) if name and number.isascii() and number.isdigit() and len(number) < 19 else None


def outbox_name(first: int) -> str:
    """Return a new name of an outbox, whose first message has this number."""
    return f"{secrets.token_hex(8)}.{first}"


def first_number(outbox: str) -> int:
    """Return the number of the first message of an outbox, by its name."""
    number = outbox.partition(".")[2]
    return int(number) if number.isascii() and number.isdigit() and len(number) < 19 else 1


def nats_library(where: str) -> Any:
    """Return the module `nats`.

    Raises
    ------
    ConfigError
        If it is not installed.
    """
    try:
        return import_module("nats")
    except ImportError as error:
        raise ConfigError([Fault(where, "needs the package nats-py; pip install 'livessl[hub]'")]) from error


@asynccontextmanager
async def connected(
    nats: Any,
    options: dict[str, Any],
    failed: Callable[[Exception], Awaitable[None]],
    lost: Callable[[], Awaitable[None]],
) -> AsyncIterator[Client]:
    """A connection to NATS, closed at the end of the context; the caller makes another one when it is lost.

    The library would connect again by itself, but forgets to close connections whose handshake failed.

    Parameters
    ----------
    nats : module
    options : dict of str to Any
        Arguments of `connect`.
    failed : callable
        Gets the errors that the library reports.
    lost : callable
        Called when the connection is lost.
    """
    client: Client = _encrypting_client(nats) if "tls" in options else nats.NATS()
    try:
        await client.connect(**options, error_cb=failed, disconnected_cb=lost)
        yield client
    finally:
        with suppress(Exception):
            async with asyncio.timeout(CLOSE_S):
                await client.close()


async def until_one_ends(*works: Coroutine[Any, Any, object]) -> None:
    """Do some works at a time until one of them ends, and end the others; raise the error that has ended it."""
    tasks = [asyncio.create_task(work) for work in works]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        await ended(*tasks)
    for task in done:
        task.result()


async def ended(*tasks: asyncio.Task[Any]) -> None:
    """End tasks, and return when they have ended, whatever they say to it.

    A task is cancelled again as long as it goes on: Python 3.11 loses a cancellation that comes at the moment at which
    what `wait_for` waits for is there, as the next message is all the time under load. If the caller is cancelled
    meanwhile, by the same rule more than once, that is raised once all have ended.
    """
    left, cancelled = set(tasks), None
    while left:
        for task in left:
            task.cancel()
        try:
            await asyncio.wait(left, timeout=CANCEL_S)
        except asyncio.CancelledError as error:
            cancelled = error
        left = {task for task in left if not task.done()}
    for task in tasks:
        if not task.cancelled():
            task.exception()  # takes note of it
    if cancelled is not None:
        raise cancelled


def _encrypting_client(nats: Any) -> Client:
    """Return a client that ends a connection whose server offers no TLS, before it sends its user and password.

    The library starts TLS only if the first line of the server, which anyone on the way can change, asks for it.
    """

    class EncryptingClient(nats.NATS):  # type: ignore[misc]
        def _connect_command(self) -> bytes:
            """Return what a client sends first, which has its user and password."""
            url = self._current_server.uri
            if url.scheme == "tls" and self._transport._io_writer.get_extra_info("ssl_object") is None:
                cure = "set tls in its nats.conf, or see who answers there"
                raise nats.errors.Error(f"{url.netloc} offers no TLS; {cure}")
            text: bytes = super()._connect_command()
            return text

    client: Client = EncryptingClient()
    return client


def _token(site: str) -> str:
    """Return a site's name as one part of a subject, in which a dot separates no parts."""
    return site.replace(".", "%2E")


def connect_options(config: NatsConfig, file: Callable[[str], Path], where: str) -> dict[str, Any]:
    """Return the arguments of `nats.connect`, for one connection.

    Parameters
    ----------
    config : NatsConfig
    file : callable
        Returns the path of a file that the configuration names.
    where : str
        Place of the configuration, for errors.

    Raises
    ------
    ConfigError
        If a file cannot be used.
    """
    options: dict[str, Any] = {
        "servers": list(config.servers),
        "connect_timeout": CONNECT_S,
        "reconnect_time_wait": RECONNECT_S,
        "max_reconnect_attempts": 1,
        "allow_reconnect": False,
        "ping_interval": PING_S,
        "max_outstanding_pings": 2,
    }
    if config.user is not None and config.password is not None:
        options["user"] = config.user
        options["password"] = read_secret(file(config.password), "write the password into it").strip()
    if config.credentials is not None:
        path = file(config.credentials)
        read_secret(path, "write the credentials of the user into it")
        options["user_credentials"] = str(path)
    if config.ca is not None or any(url.startswith("tls:") for url in config.servers):
        options["tls"] = _tls(config, file, where)
    return options


def _tls(config: NatsConfig, file: Callable[[str], Path], where: str) -> ssl.SSLContext:
    authorities = None if config.ca is None else file(config.ca)
    try:
        context = ssl.create_default_context(cafile=authorities)
    except (OSError, ssl.SSLError) as error:
        what = f"cannot read certificates from {authorities}: {error}; name a PEM file"
        raise ConfigError([Fault(f"{where}.ca", what)]) from error
    if config.certificate is not None and config.private_key is not None:
        certificate, key = file(config.certificate), file(config.private_key)
        try:
            context.load_cert_chain(certificate, key, password="")
        except (OSError, ssl.SSLError) as error:
            what = f"cannot use {certificate} with {key}: {error}; name a PEM certificate and its key"
            raise ConfigError([Fault(f"{where}.certificate", what)]) from error
    return context
