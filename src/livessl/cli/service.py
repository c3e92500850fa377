"""Finds the service manager (systemd) of a command that runs until it is stopped."""

from __future__ import annotations

import faulthandler

from livessl.clock import SystemClock
from livessl.service_manager import ServiceManager


def service_manager() -> ServiceManager:
    """Return the service manager of the environment; call it before anything else can start a program.

    If the service manager watches this process, it kills it by SIGABRT when it hangs; the process then prints where
    each of its threads is.
    """
    service = ServiceManager.of_environment(SystemClock())
    if service.watches:
        faulthandler.enable()
    return service
