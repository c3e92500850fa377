"""Many WebSocket clients, some of them stalled: a small case of `benchmarks/clients.py`."""

from __future__ import annotations

import socket
import struct
from threading import Event
from typing import Any

import pytest

from clients import MAX_CLIENT_KB, measure, open_client
from livessl.server.app import Server
from livessl.server.fanout import BACKLOG
from messages import update_message
from small_site import HANG_S, running_server, site_of, wait_until


@pytest.mark.processes
def test_stalled_clients_delay_no_other_client_and_cost_little_memory() -> None:
    outcome = measure(clients=12, stalled=4, updates_per_s=100.0, seconds=6.0)
    # a server that waits for the stalled ones would be late by SEND_TIMEOUT_S, 30 s; a busy machine, by less than one
    assert outcome.delay_p50_ms < 1000.0
    assert outcome.received > outcome.expected / 2
    # what all share besides, with two clients as with forty: 256 messages as Python objects, imports of a first request
    assert outcome.rss_peak_mb - outcome.rss_before_mb < 12 * MAX_CLIENT_KB / 1000 + 30.0


def test_client_that_leaves_with_messages_on_their_way_causes_no_log_line(caplog: pytest.LogCaptureFixture) -> None:
    """Its queue is not written to the closed connection; asyncio would log a warning for each message."""
    with running_server(site_of()) as server:
        client = open_client("127.0.0.1", int(server.url.rpartition(":")[2]), None)
        wait_until(lambda: server.parts.fanout.clients == 1, "its place")
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closing cuts at once
        done = Event()

        def leave() -> None:
            client.close()
            for number in range(BACKLOG):
                server.parts.fanout.publish(update_message(event_id=str(number)))
            done.set()

        assert server.loop is not None
        server.loop.call_soon_threadsafe(leave)
        assert done.wait(timeout=HANG_S)
        wait_until(lambda: server.parts.fanout.clients == 0, "its place to be free")
    assert [record.getMessage() for record in caplog.records if record.name == "asyncio"] == []


def test_server_stops_while_a_client_closes_its_socket() -> None:
    """A client that has sent a closing frame but does not read stays in the state of closing until its last byte."""
    with running_server(site_of()) as server:
        client = open_client("127.0.0.1", int(server.url.rpartition(":")[2]), 4096)
        wait_until(lambda: server.parts.fanout.clients == 1, "its place")
        assert server.loop is not None
        text = "x" * 100_000  # more than the two sockets' buffers hold
        for number in range(8):
            message = update_message(event_id=f"{number}{text}")
            server.loop.call_soon_threadsafe(server.parts.fanout.publish, message)
        wait_until(lambda: any(c.transport.get_write_buffer_size() for c in connections(server)), "the unread")
        client.sendall(bytes([0x88, 0x80, 0, 0, 0, 0]))  # a closing frame, masked with zeros
        wait_until(lambda: server.parts.fanout.clients == 0, "its leaving to be noticed")
        assert connections(server)
    client.close()


def connections(server: Server) -> list[Any]:
    return list(server.uvicorn.server_state.connections)
