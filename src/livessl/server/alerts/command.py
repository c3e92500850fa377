"""Commands: an alert starts a program, which gets it as JSON on its standard input."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from typing import Final

import orjson

from livessl.server.alerts.actions import ActionSetting, DeliveryError
from livessl.server.alerts.message import title
from livessl.server.api.encode import JsonObject

MAX_ERROR: Final = 300
"""Longest part of a program's last error output, in characters, that is kept as the reason of a failure."""


class Command:
    """Runs a program for each alert, in the site file's folder and without a shell.

    Parameters
    ----------
    setting : ActionSetting
    """

    def __init__(self, setting: ActionSetting) -> None:
        command = setting.config.command
        assert command is not None
        program, *arguments = command
        if "/" in program:
            program = str(setting.site.file(program).absolute())
        self._command = (program, *arguments)
        self._folder = setting.site.directory
        self._timeout_s = setting.config.timeout_s

    @asynccontextmanager
    async def connected(self, ready: Callable[[], None]) -> AsyncIterator[None]:  # noqa: ARG002
        """Keep nothing open."""
        yield

    async def deliver(self, alert: JsonObject) -> None:
        """Run the program; it has accepted the alert if it exits with 0.

        Its environment names the alert's key, rule, title, text and link: `LIVESSL_ALERT_KEY` and so on.

        Raises
        ------
        DeliveryError
            If it cannot be started, takes too long, or exits with another code.
        """
        about = {name: str(alert[name]) for name in ("key", "rule", "text", "link")} | {"title": title(alert)}
        environment = {**os.environ, **{f"LIVESSL_ALERT_{name.upper()}": value for name, value in about.items()}}
        try:
            process = await asyncio.create_subprocess_exec(
                *self._command,
                cwd=self._folder,
                env=environment,
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.DEVNULL,
                stderr=asyncio.subprocess.PIPE,
                start_new_session=True,
            )
        except OSError as error:
            raise DeliveryError(f"cannot run {self._command[0]}: {error.strerror}") from error
        try:
            async with asyncio.timeout(self._timeout_s):
                _, errors = await process.communicate(orjson.dumps(alert))
        except TimeoutError as error:
            raise DeliveryError(f"{self._command[0]} did not end within {self._timeout_s:g} s") from error
        finally:
            if process.returncode is None:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                await process.wait()
        if process.returncode != 0:
            lines = errors.decode(errors="replace").split("\n")
            last = next((line.strip() for line in reversed(lines) if line.strip()), "")
            why = f": {last[:MAX_ERROR]}" if last else ""
            raise DeliveryError(f"{self._command[0]} exited with {process.returncode}, expected 0{why}")
