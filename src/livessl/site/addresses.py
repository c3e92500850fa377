"""Network addresses of the site file: their syntax, and whether other machines can reach them."""

from __future__ import annotations

import re
from ipaddress import ip_address


def check_endpoint(endpoint: str, *, wildcards: bool = False) -> str:
    """Return `endpoint` if it is a ZeroMQ TCP or IPC address.

    Parameters
    ----------
    endpoint : str
    wildcards : bool
        Allow `*` for host or port: a server can bind to it, but no client can connect to it.

    Raises
    ------
    ValueError
        If it is something else.
    """
    scheme, _, rest = endpoint.partition("://")
    host, _, port = rest.rpartition(":")
    numbered = re.fullmatch("[0-9]{1,5}", port) is not None and int(port) <= 65535
    tcp = scheme == "tcp" and host != "" and (numbered or port == "*") and (wildcards or "*" not in (host, port))
    if not (tcp or (scheme == "ipc" and rest)):
        raise ValueError(f"expected tcp://HOST:PORT or ipc://PATH, got {endpoint!r}")
    return endpoint


def is_loopback(host: str) -> bool:
    """Return True if only this machine can reach a server that listens on `host`."""
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"
