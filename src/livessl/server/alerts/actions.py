"""The interface of actions that deliver alerts, their registry `ACTIONS`, and the TLS with which they connect."""

from __future__ import annotations

import asyncio
import ssl
import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from importlib import import_module
from pkgutil import resolve_name
from typing import Any, Final, Protocol, TypeVar, cast

from livessl.clock import Clock
from livessl.errors import ConfigError, Fault
from livessl.server.alerts.evidence import Evidence
from livessl.server.api.encode import JsonObject
from livessl.site.alert_models import AlertAction
from livessl.site.models import Site

ACTIONS: Final[dict[str, str | Callable[..., object]]] = {
    "webhook": "livessl.server.alerts.webhook:Webhook",
    "mqtt": "livessl.server.alerts.mqtt:Mqtt",
    "command": "livessl.server.alerts.command:Command",
    "apprise": "livessl.server.alerts.notification:Notification",
}
"""Maps the key in a site file to the factory of the action, which gets an `ActionSetting` and returns an `Action`. A
factory is a callable, or the text "module:attribute" of one that is imported when a server needs it."""

T = TypeVar("T")


class DeliveryError(Exception):
    """A failed attempt to deliver an alert.

    Parameters
    ----------
    reason : str
        Reason of the failure, in words.
    retry_after_s : float or None
        Shortest wait, in seconds, that the receiver requests.
    hopeless : bool
        Whether no further attempt can succeed.
    """

    def __init__(self, reason: str, *, retry_after_s: float | None = None, hopeless: bool = False) -> None:
        super().__init__(reason)
        self.retry_after_s = retry_after_s
        self.hopeless = hopeless


class Action(Protocol):
    """Delivers alerts, one at a time, on the event loop of the alerts."""

    def connected(self, ready: Callable[[], None]) -> AbstractAsyncContextManager[None]:
        """Return a context in which the action keeps its connection, if any; it calls `ready` after connecting."""
        ...

    async def deliver(self, alert: JsonObject) -> None:
        """Deliver an alert, within the action's `timeout_s` or soon after it.

        Raises
        ------
        DeliveryError
            If the alert did not arrive, or was not confirmed.
        """
        ...


@dataclass(frozen=True, slots=True)
class ActionSetting:
    """Settings from which an action is made.

    Parameters
    ----------
    name : str
        Name of the action in the site file.
    config : AlertAction
    site : Site
    clock : Clock
    rules : sequence of str
        Names of the rules that use the action.
    other_rules : sequence of str
        Names of rules that use no action of this type, including rules that are no longer in the site file.
    url : str
        Address of the server for people.
    evidence : Evidence
        Makes the attachments of alerts.
    """

    name: str
    config: AlertAction
    site: Site
    clock: Clock
    rules: Sequence[str]
    other_rules: Sequence[str]
    url: str
    evidence: Evidence

    @property
    def place(self) -> str:
        """Place of the action's settings in the site file."""
        return f"alerts.actions.{self.name}.{self.config.kind}"


def optional_library(setting: ActionSetting, name: str) -> Any:
    """Return a module of the extra `alerts` that an action needs.

    Raises
    ------
    ConfigError
        If it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        what = f"needs the package {name}; pip install 'livessl[alerts]'"
        raise ConfigError([Fault(setting.place, what)]) from error


def client_tls(setting: ActionSetting, certificates: str | None) -> ssl.SSLContext:
    """Return the TLS context with which an action connects.

    Parameters
    ----------
    setting : ActionSetting
    certificates : str or None
        PEM file of the authorities to trust, as the site file names it; None for those of the system.

    Raises
    ------
    ConfigError
        If the file cannot be read.
    """
    file = None if certificates is None else setting.site.file(certificates)
    try:
        return ssl.create_default_context(cafile=file)
    except (OSError, ssl.SSLError) as error:
        what = f"cannot read certificates from {file}: {error}; name a PEM file"
        raise ConfigError([Fault(f"{setting.place}.ca", what)]) from error


def make_action(setting: ActionSetting) -> Action:
    """Return an action of the type that its configuration names.

    Raises
    ------
    ConfigError
        If a file that it names, or a library that it needs, cannot be used.
    """
    factory = ACTIONS[setting.config.kind]
    make = resolve_name(factory) if isinstance(factory, str) else factory
    return cast(Action, make(setting))


async def in_daemon_thread(work: Callable[[], T]) -> T:
    """Run blocking work in a new daemon thread, for which the end of the process does not wait."""
    loop, done = asyncio.get_running_loop(), asyncio.get_running_loop().create_future()

    def settle(result: T | None, error: Exception | None) -> None:
        if done.cancelled():
            return
        if error is None:
            done.set_result(result)
        else:
            done.set_exception(error)

    def run() -> None:
        result, error = None, None
        try:
            result = work()
        except Exception as caught:  # noqa: BLE001 - raised where the work is awaited
            error = caught
        if not loop.is_closed():
            loop.call_soon_threadsafe(settle, result, error)

    threading.Thread(target=run, name="alert", daemon=True).start()
    return cast(T, await done)
