"""Delivers alerts by Apprise: as e-mail, or to chats such as Slack and a hundred other services."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from livessl.server.alerts.actions import ActionSetting, DeliveryError, in_daemon_thread, optional_library
from livessl.server.alerts.message import body, title
from livessl.server.alerts.outbox import MAX_WAITING
from livessl.server.api.encode import JsonObject
from livessl.site.secret_files import fault, read_secret

LEAST_BYTES_PER_S: Final = 250_000.0
"""Slowest transfer of files, in bytes per second, that does not count as a failure: an uplink of 2 Mbit/s."""


class Notification:
    """Sends alerts to one service.

    Parameters
    ----------
    setting : ActionSetting

    Raises
    ------
    ConfigError
        If Apprise is not installed, or the file holds no URL that Apprise knows.
    """

    def __init__(self, setting: ActionSetting) -> None:
        config = setting.config.apprise
        assert config is not None
        apprise = optional_library(setting, "apprise")
        path = setting.site.file(config.url)
        lines = read_secret(path, "write one URL of Apprise into it").split()
        service = apprise.Apprise.instantiate(lines[0]) if len(lines) == 1 else None
        if service is None:  # the text may hold a password, and is not repeated
            raise fault(path, "expected one URL of a service that Apprise knows; see docs/alerts.md")
        self._apprise = apprise
        self._service = service
        self._attached = config.attach if service.attachment_support else ()
        self._evidence = setting.evidence
        self._rules = setting.site.alerts.rules
        self._timeout_s = setting.config.timeout_s
        self._failed: deque[str] = deque(maxlen=MAX_WAITING)  # keys of alerts that are sent without files

    @asynccontextmanager
    async def connected(self, ready: Callable[[], None]) -> AsyncIterator[None]:  # noqa: ARG002
        """Open no connection in advance."""
        yield

    async def deliver(self, alert: JsonObject) -> None:
        """Send an alert. Its files are omitted after a failed attempt, because they may have caused the failure.

        Raises
        ------
        DeliveryError
            If the service does not accept the alert in time.
        """
        picture, clip = (None, None) if alert["key"] in self._failed else await self._files(alert)
        try:
            await self._send_in_time(alert, picture, clip)
        except DeliveryError:
            if picture is not None or clip is not None:
                self._failed.append(alert["key"])
            raise

    async def _files(self, alert: JsonObject) -> tuple[bytes | None, Path | None]:
        """Return the picture and the clip to attach; alerts of a rule with `early` do not wait for a clip."""
        picture = self._evidence.picture(alert) if "picture" in self._attached else None
        if "clip" not in self._attached:
            return picture, None
        rule = self._rules.get(alert["rule"])
        may_be_early = rule is not None and rule.events is not None and rule.events.early
        return picture, await self._evidence.clip(alert, waits=not may_be_early)

    async def _send_in_time(self, alert: JsonObject, picture: bytes | None, clip: Path | None) -> None:
        nbytes = len(picture or b"")
        if clip is not None:
            with suppress(OSError):  # it may have been deleted meanwhile
                nbytes += clip.stat().st_size
        within_s = self._timeout_s + nbytes / LEAST_BYTES_PER_S
        try:
            async with asyncio.timeout(within_s):
                accepted = await in_daemon_thread(partial(self._send, alert, picture, clip))
        except TimeoutError as error:
            raise DeliveryError(f"no answer within {within_s:.3g} s") from error
        except Exception as error:
            raise DeliveryError(f"{type(error).__name__}: {error}") from error
        if not accepted:
            raise DeliveryError("the service did not accept it; the log of Apprise says why")

    def _send(self, alert: JsonObject, picture: bytes | None, clip: Path | None) -> bool:
        """Send an alert with its attachments; return whether the service has accepted it."""
        with TemporaryDirectory(prefix="livessl-alert-") as folder:
            files = []
            if picture is not None:
                files.append(Path(folder) / "map.png")
                files[-1].write_bytes(picture)
            if clip is not None and clip.is_file():  # it may have been deleted meanwhile
                files.append(clip)
            attached = self._apprise.AppriseAttachment([str(file) for file in files]) if files else None
            return bool(self._service.notify(title=title(alert), body=body(alert), attach=attached))
