"""Checks network addresses of the site file: syntax, IPv6, origins, proxies, whether other machines can reach them."""

from __future__ import annotations

import re
from ipaddress import AddressValueError, IPv6Address, ip_address, ip_network
from typing import Final

LOOPBACK: Final = ("127.0.0.1", "localhost", "::1")
"""Names of this machine by which a node reaches the same server."""


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
    if tcp and (":" in host or "[" in host) and not (host[0] == "[" and host[-1] == "]" and is_ipv6(host[1:-1])):
        raise ValueError(f"expected an IPv6 address in brackets, such as tcp://[::1]:5570, got {endpoint!r}")
    return endpoint


def check_host(host: str) -> str:
    """Return the host that an HTTP server listens on, an IPv6 address without its brackets.

    Raises
    ------
    ValueError
        If it is neither a name nor an address.
    """
    bare = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    if (":" in bare or bare != host) and not is_ipv6(bare):
        raise ValueError(
            f"expected a name or an address without a port, such as lab-pc, 127.0.0.1 or ::1, got {host!r}"
        )
    return bare


def check_trusted_host(name: str) -> str:
    """Return a host name in lower case that requests may be addressed to; `*.` stands for every name below another.

    Raises
    ------
    ValueError
        If it is something else, such as a URL or a name with a port.
    """
    lower = name.lower()
    if is_ipv6(lower.strip("[]")):
        return in_url(lower.strip("[]"))
    if re.fullmatch(r"(\*\.)?[a-z0-9_-]+(\.[a-z0-9_-]+)*", lower) is None:
        raise ValueError(
            f"expected a host name without scheme and port, such as site.example or *.site.example, got {name!r}"
        )
    return lower


def check_origin(text: str) -> str:
    """Return the origin of pages, such as `https://site.example`, in lower case.

    Raises
    ------
    ValueError
        If it is none: with a path, without a scheme, or a pattern.
    """
    origin = text.lower()
    if re.fullmatch(r"https?://([a-z0-9._-]+|\[[0-9a-f:]+\])(:[0-9]{1,5})?", origin) is None:
        raise ValueError(f"expected the origin of a page without a path, such as https://site.example, got {text!r}")
    return origin


def check_root_path(path: str) -> str:
    """Return the path under which a reverse proxy serves the site, without a slash at its end; empty for none.

    Raises
    ------
    ValueError
        If it is no path.
    """
    bare = path.rstrip("/")
    if re.fullmatch(r"(/[A-Za-z0-9._~-]+)*", bare) is None:
        raise ValueError(f"expected a path such as /livessl, got {path!r}")
    return bare


def check_network(text: str) -> str:
    """Return an IP address, or a network such as 10.0.0.0/8.

    Raises
    ------
    ValueError
        If it is something else.
    """
    try:
        ip_network(text)
    except ValueError as error:
        raise ValueError(
            f"expected an address or a network of proxies, such as 127.0.0.1 or 10.0.0.0/8, got {text!r}"
        ) from error
    return text


def is_ipv6(host: str) -> bool:
    """Return True if `host` is an IPv6 address, without brackets; a link-local one may name its interface."""
    try:
        IPv6Address(host)
    except AddressValueError:
        return False
    return True


def needs_ipv6(endpoint: str) -> bool:
    """Return True if a ZeroMQ socket needs IPv6 for `endpoint`.

    For other endpoints it must stay off: ZeroMQ would then use nothing but the IPv6 address of a name that has both.
    """
    return endpoint.startswith("tcp://[")


def same_on_loopback(endpoint: str) -> str:
    """Return a ZeroMQ address in one spelling: in lower case, and with 127.0.0.1 for its aliases on this machine."""
    scheme, _, rest = endpoint.partition("://")
    if scheme != "tcp":
        return endpoint
    host, _, port = rest.lower().rpartition(":")
    bare = plain_address(host.strip("[]"))
    return f"tcp://{'127.0.0.1' if bare in LOOPBACK else bare}:{port}"


def in_url(host: str) -> str:
    """Return `host` as it stands in a URL: an IPv6 address in brackets (RFC 3986, RFC 6874)."""
    return f"[{host.replace('%', '%25')}]" if ":" in host else host


def plain_address(address: str) -> str:
    """Return the IPv4 address of a client that a socket for both families presents as ::ffff:192.0.2.1."""
    try:
        mapped = IPv6Address(address).ipv4_mapped
    except AddressValueError:
        return address
    return address if mapped is None else str(mapped)


def is_loopback(host: str) -> bool:
    """Return True if only this machine can reach a server that listens on `host`."""
    try:
        return ip_address(plain_address(host.strip("[]"))).is_loopback
    except ValueError:
        return host == "localhost"
