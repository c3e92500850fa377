"""Delivers an alert to a program, which gets it as JSON on its standard input and accepts it by exit code 0."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from tempfile import TemporaryFile
from typing import IO, Final

import orjson

from livessl.server.alerts.actions import ActionSetting, DeliveryError
from livessl.server.alerts.message import title
from livessl.server.api.encode import JsonObject

LAST_ERRORS: Final = 4096
"""Number of last bytes of a program's error output in which its last line is searched for."""

MAX_ERROR: Final = 300
"""Largest number of characters of a program's error output that are kept as the reason of a failure."""


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
        """Open no connection, because a program needs none."""
        yield

    async def deliver(self, alert: JsonObject) -> None:
        """Run the program, which accepts the alert by exiting with 0.

        Its environment contains the alert's key, rule, title, text and link: `LIVESSL_ALERT_KEY` and so on.

        Raises
        ------
        DeliveryError
            If the program cannot be started, takes too long, or exits with another code.
        """
        about = {name: str(alert[name]) for name in ("key", "rule", "text", "link")} | {"title": title(alert)}
        with TemporaryFile() as errors:  # a pipe would stay open as long as a program that this one leaves behind
            code = await self._run(orjson.dumps(alert), about, errors)
            if code == 0:
                return
            errors.seek(max(0, errors.seek(0, os.SEEK_END) - LAST_ERRORS))
            lines = errors.read().decode(errors="replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")
        why = f": {last[:MAX_ERROR]}" if last else ""
        raise DeliveryError(f"{self._command[0]} exited with {code}, expected 0{why}")

    async def _run(self, given: bytes, about: Mapping[str, str], errors: IO[bytes]) -> int | None:
        """Run the program with `given` on its standard input; return its exit code."""
        environment = {**os.environ, **{f"LIVESSL_ALERT_{name.upper()}": value for name, value in about.items()}}
        try:
            process = await asyncio.create_subprocess_exec(
                *self._command,
                cwd=self._folder,
                env=environment,
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.DEVNULL,
                stderr=errors,
                start_new_session=True,
            )
        except OSError as error:
            raise DeliveryError(f"cannot run {self._command[0]}: {error.strerror}") from error
        try:
            async with asyncio.timeout(self._timeout_s):
                await process.communicate(given)
        except TimeoutError as error:
            raise DeliveryError(f"{self._command[0]} did not end within {self._timeout_s:g} s") from error
        finally:
            if process.returncode is None:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                await process.wait()
        return process.returncode
