"""What of one run must not be seen in the next one."""

from __future__ import annotations

import numpy as np
from world import World
from world_parts import START

from livessl import wire
from livessl.core.types import FRAME_NS, Track, TrackState
from livessl.server.api.encode import Messages
from livessl.server.receiver import Joined

LIVE = wire.Hello("a", "run-1", {"north": 16000.0})
REPLAY = wire.Hello("replay", "run-2", {"south": 16000.0}, replay=True)


def test_tracks_of_a_replay_that_died_end_before_a_live_run_begins() -> None:
    world = World(1)
    server = world.server
    assert server is not None
    world.post.queue.append(Joined(REPLAY))
    server.engine.turn()
    time_ns = START * FRAME_NS
    track = Track(7, TrackState.UPDATE, time_ns, np.ones(3), np.zeros(3), np.eye(3))
    server.tracks.note(track, Messages(world.site, time_ns, utc=True).track(track))
    world.post.queue.append(Joined(LIVE))
    server.engine.turn()
    assert server.site_time.mode == "live"
    assert server.tracks.all() == []
    assert [(one["id"], one["state"]) for one in world.published if one["kind"] == "track"] == [(7, "end")]
