"""What a link keeps while the server is away, and the order in which it is sent."""

from __future__ import annotations

import numpy as np

from link_router import Router, connect, free_endpoint, linked, together
from livessl import wire
from livessl.capture.outbox import BACKLOG_FRAMES
from livessl.capture.spool import MEMORY_BYTES
from livessl.core.types import Frame
from small_site import FIRST_FRAME_INDEX, frame, wait_until


def test_spool_is_bounded_and_dropped_frames_are_counted() -> None:
    samples = np.zeros((16, wire.MAX_FRAME_SAMPLES), dtype=np.float32)
    size = samples.nbytes
    count = MEMORY_BYTES // size + 20
    endpoint = free_endpoint()
    with linked(endpoint) as link:
        for k in range(1, count + 1):
            link.send([Frame("north", k, k, k, 384_000.0, samples, 0.0, True)])
        assert link.dropped + link.pending == count
        assert 20 <= link.dropped <= 21
        assert link.pending * size <= MEMORY_BYTES < (link.pending + 2) * size
        with Router(endpoint) as router:
            connect(link, router)
            kept = list(range(link.dropped + 1, count + 1))  # the oldest were dropped

            def all_taken() -> bool:
                link.service()
                if router.read() and router.frames():
                    frame_indices = {"north": router.frames()[-1]}
                    router.send(wire.encode(wire.Ack("run-1", frame_indices)))
                return link.pending == 0

            wait_until(all_taken, "the backlog")
            assert router.frames() == kept


def test_live_sound_goes_first_and_the_backlog_follows_in_order_of_time() -> None:
    endpoint = free_endpoint()
    kept = [frame(k) for k in range(1, 51)]
    with linked(endpoint) as link:
        link.send(kept)
        with Router(endpoint) as router:
            together(link, router, router.hellos, "a greeting")
            router.ack()
            together(link, router, lambda: link.connected, "the connection")
            link.send([frame(51), frame(52)])
            together(
                link,
                router,
                lambda: len(router.frames()) == 2 + BACKLOG_FRAMES,
                "live sound, and a part of the backlog",
            )
            assert router.hellos()[-1].backlog == {"north": (FIRST_FRAME_INDEX + 1, FIRST_FRAME_INDEX + 51)}
            assert router.frames() == [*range(1, BACKLOG_FRAMES + 1), 51, 52] or router.frames()[:2] == [51, 52]
            router.ack(north=10)
            together(link, router, lambda: len(router.frames()) == 12 + BACKLOG_FRAMES, "ten more")
            link.send([frame(53)])
            together(link, router, lambda: 53 in router.frames(), "the live frame")
            assert 27 not in router.frames()  # the live frame preceded the rest of the backlog
            for k in (26, 42, 50):
                router.ack(north=k)
                together(link, router, lambda k=k: min(50, k + 16) in router.frames(), "more of the backlog")  # type: ignore[misc]
            together(link, router, lambda: router.hellos()[-1].backlog == {}, "the greeting without backlog")
            assert sorted(router.frames()) == list(range(1, 54))
            router.ack(north=53)
            together(link, router, lambda: link.pending == 0, "the acknowledgement")
            assert link.kept == 53  # until it is settled
            router.ack(settled=50, north=53)
            together(link, router, lambda: link.kept == 4, "the settlement")


def test_settled_frames_that_the_server_never_received_are_sent() -> None:
    """The server may have settled without this node, and shall still receive its frames."""
    endpoint = free_endpoint()
    with linked(endpoint) as link:
        link.send([frame(k) for k in range(1, 6)])
        with Router(endpoint) as router:
            together(link, router, router.hellos, "a greeting")
            router.ack(settled=100)
            together(link, router, lambda: len(router.frames()) == 5, "the frames")
            router.ack(settled=100, north=5)
            together(link, router, lambda: link.kept == 0, "the settlement")
