"""Messages of the wire, damaged: bits, lengths, cuts, splices of two; nothing but a message or a refusal may follow."""

from __future__ import annotations

import random
from collections import Counter

import numpy as np

from livessl import wire
from livessl.core.types import ChannelLevel, Frame, HostState, Mark
from livessl.server.ingest import Ingest
from small_site import site_of


def originals() -> list[bytes]:
    """One message of every kind; the frame is small, so that its head is hit often."""
    frame = Frame("north", 7, 1000, 50_000_000_000, 16000.0, np.ones((4, 8), np.float32), 0.01, True)
    hello = wire.Hello("a", "run-1", {"north": 16000.0, "south": 16000.0}, backlog={"north": (900, 1000)})
    messages: list[wire.WireMessage] = [
        frame,
        Mark("north", 7, 1001, 1e-6, 1e-6, (1e-6,) * 4),
        hello,
        wire.Ack("run-1", {"north": 1000}, 900),
        wire.Bye("a", "run-1"),
        wire.Welcome("run-1", (wire.SECTIONS,)),
    ]
    return [wire.encode(message) for message in messages]


def with_sections() -> bytes:
    """A mark that ends with sections of every kind."""
    level = ChannelLevel(-20.0, -40.0, 3, 0.001, 50.0, -50.0, -70.0, 12.0)
    host = HostState(True, "chrony", "ntp.example", 0.001, 2, 0.5, False, "lab-pc")
    mark = Mark("north", 7, 1002, 1e-6, 1e-6, (1e-6,) * 4, levels=(level,) * 4, drift_error_ppm=2.0, host=host)
    return wire.encode(mark)


def mutated(rng: random.Random, pool: list[bytes]) -> bytes:
    """One of them, changed in one to four ways."""
    data = bytearray(rng.choice(pool))
    for _ in range(rng.randint(1, 4)):
        where = rng.randrange(len(data) + 1)
        match rng.randrange(6):
            case 0 if data:
                data[where % len(data)] ^= 1 << rng.randrange(8)
            case 1 if data:
                data[where % len(data)] = rng.choice((0, 1, 0x7F, 0x80, 0xFF))
            case 2:
                del data[where:]
            case 3:
                data[where:where] = rng.randbytes(rng.randint(1, 9))
            case 4:
                other = rng.choice(pool)
                data[where:] = other[rng.randrange(len(other)) :]
            case _:
                del data[where : where + rng.randint(1, 9)]
    return bytes(data)


def campaign(count: int, seed: int) -> Counter[str]:
    """Give so many damaged messages to a server's ingest that knows a good node; how many were what.

    Anything but a refusal in words is an exception that ends it. What still decodes must be a message that encodes.
    """
    rng = random.Random(seed)
    pool = [*originals(), with_sections(), with_sections()]
    site = site_of()
    ingest = Ingest(site)
    outcomes: Counter[str] = Counter()
    for k in range(count):
        if k % 1000 == 0:
            ingest.receive(b"good", pool[2], k)
        data = mutated(rng, pool)
        try:
            message = wire.decode(data)
        except wire.WireError:
            outcomes["refused"] += 1
        else:
            wire.encode(message)
            outcomes[type(message).__name__] += 1
        ingest.receive(rng.choice((b"good", b"bad")), data, k)
        ingest.acknowledgements(k)
    return outcomes
