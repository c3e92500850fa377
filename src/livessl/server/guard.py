"""Decides by its key whether a node may connect to the nodes' port (CURVE encryption, ZAP), on a thread of its own.

`ingest` answers the greetings of connected nodes, and refuses some.

pyzmq's `ThreadAuthenticator` does not serve here. Its callback gets the key but not the caller's address, which the
list of refusals needs, and it does not report that its thread has failed. Handshakes that fail before a key is shown
would need a socket monitor, on a thread of its own, anyway.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from typing import Final

import zmq
from zmq.utils.monitor import recv_monitor_message

from livessl.server.refusals import Refusals
from livessl.site.addresses import plain_address
from livessl.site.keys import ServerKeys

DOOR: Final = "nodes"

ZAP_ENDPOINT: Final = "inproc://zeromq.zap.01"
DOMAIN: Final = b"nodes"

HANDSHAKE_MS: Final = 5000
"""Longest time, in milliseconds, that a handshake may take."""

_BROKEN: Final = {
    int(zmq.Event.HANDSHAKE_FAILED_PROTOCOL): "without keys, or with another server's",
    int(zmq.Event.HANDSHAKE_FAILED_NO_DETAIL): "broke off the handshake",
}
"""Reasons of handshakes that fail before a key is shown, by the monitor's event; it does not give their address."""

_log = logging.getLogger(__name__)


def guard(
    context: zmq.Context[zmq.Socket[bytes]],
    socket: zmq.Socket[bytes],
    keys: ServerKeys,
    refusals: Refusals,
    failed: Callable[[BaseException], None],
) -> None:
    """Let only enrolled nodes connect to a socket, until its context ends.

    Parameters
    ----------
    context : zmq.Context
    socket : zmq.Socket
        The server's, not yet bound. Its messages will carry the node's name as their `User-Id`.
    keys : ServerKeys
    refusals : Refusals
        Counts every refused handshake.
    failed : callable
        Gets the error that ends the thread; from then on no node can connect.
    """
    socket.setsockopt(zmq.CURVE_SERVER, 1)
    socket.setsockopt(zmq.CURVE_SECRETKEY, keys.own.secret)
    socket.setsockopt(zmq.ZAP_DOMAIN, DOMAIN)
    socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)  # without the thread below no node can connect
    socket.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
    monitor = socket.get_monitor_socket(sum(_BROKEN))
    handler: zmq.Socket[bytes] = context.socket(zmq.REP)
    handler.setsockopt(zmq.LINGER, 0)
    handler.bind(ZAP_ENDPOINT)
    names = {key: name for name, key in keys.nodes.items()}
    threading.Thread(target=_run, args=(handler, monitor, names, refusals, failed), name="guard", daemon=True).start()


def _run(
    handler: zmq.Socket[bytes],
    monitor: zmq.Socket[bytes],
    names: Mapping[bytes, str],
    refusals: Refusals,
    failed: Callable[[BaseException], None],
) -> None:
    poller = zmq.Poller()
    poller.register(handler, zmq.POLLIN)
    poller.register(monitor, zmq.POLLIN)
    with handler, monitor:
        try:
            while True:
                ready = dict(poller.poll())
                if handler in ready:
                    handler.send_multipart(_answer(handler.recv_multipart(), names, refusals))
                if monitor in ready:
                    event = int(recv_monitor_message(monitor)["event"])
                    if event in _BROKEN:
                        refusals.note(DOOR, "a peer", _BROKEN[event])
        except zmq.ContextTerminated:
            _log.debug("the guard ends with its context")
        except BaseException as error:
            _log.exception("the guard of the nodes' socket has failed")
            failed(error)
            raise


def _answer(request: list[bytes], names: Mapping[bytes, str], refusals: Refusals) -> list[bytes]:
    version, number, _domain, address, _identity, mechanism, *credentials = request
    name = names.get(credentials[0]) if mechanism == b"CURVE" and len(credentials) == 1 else None
    if name is None:
        refusals.note(DOOR, plain_address(address.decode("ascii", "replace")), "its key is not enrolled")
        return [version, number, b"400", b"not enrolled", b"", b""]
    return [version, number, b"200", b"", name.encode(), b""]
