"""A capture node: one audio device, or recordings played in its place, its arrays, and the links to its servers."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Final

from livessl import wire
from livessl.capture.device import Device
from livessl.capture.host_watch import HostWatch
from livessl.capture.link import Link
from livessl.capture.links import WAIT_NS, EncodeOnce, Links, UndeliveredError
from livessl.capture.spool import Spool
from livessl.clock import Clock
from livessl.core.stream.pipeline import Pipeline
from livessl.core.stream.segmenter import RECENT_S
from livessl.core.types import FRAME_NS, BackfillRequest, Frame, Mark, Message
from livessl.recordings.assign import AssignedRecording, make_pipelines
from livessl.recordings.play import paced_messages
from livessl.recordings.recording import TimedRecording
from livessl.service_manager import ServiceManager
from livessl.site.build.pipeline import make_pipeline
from livessl.site.keys import NodeKeys, node_keys
from livessl.site.models import Site
from livessl.site.node_models import FurtherServer, NodeConfig

MAX_PENDING: Final = 400
"""Most unacknowledged messages of a replay that is faster than real time."""

AHEAD_NS: Final = round((RECENT_S - 4.0) * 1e9)
"""Longest lead of a replay over its server, in ns of recorded time: within it the node still has the frames that the
server may request."""

END_NS: Final = 1_000_000_000
"""Recorded time, in ns, at the end of a replay that need not be settled. It exceeds the pre-roll of a next sound, which
is never settled. Once no more than this is left, every event has been published."""

STUCK_NS: Final = 3_000_000_000
"""Time, in ns, after which a replay goes on although nothing has settled since the server received everything: an array
is silent, or a sound lasts on. It leaves a busy server time to process what it has received."""

_log = logging.getLogger(__name__)


Stop = Callable[[], bool]
Progress = Callable[[int], None]


def capture_device(
    site: Site,
    name: str,
    device: Device,
    clock: Clock,
    run_id: str,
    stop: Stop,
    service: ServiceManager | None = None,
) -> None:
    """Run a node on its audio device until `stop()`, through any interruption of device or server.

    `service`, if there is one, gets a report with each block: the node is ready when its device delivers, or when the
    node waits for its device.
    """
    config: NodeConfig = site.nodes[name]
    pipeline = make_pipeline(site, config.arrays, device.sample_rate_hz, reports_levels=True)
    links = _links(site, name, [pipeline], clock, run_id)
    problem = None
    try:
        with device, HostWatch() as host:
            for block in device:
                if stop():
                    break
                if service is not None:
                    service.turn(partial(links.in_words, device.problem))
                if device.problem != problem:
                    problem = device.problem
                    _log.warning("%s", problem or f"device {device.name!r} delivers sound again")
                    links.report(problem)
                links.send(
                    with_host(pipeline.push(block), host, device.lost_blocks, sound_server=device.through_sound_server)
                )
    finally:
        if service is not None:
            service.stopping()
        links.close(bye=True)


def capture_recordings(
    site: Site,
    name: str,
    recordings: Sequence[AssignedRecording],
    clock: Clock,
    run_id: str,
    stop: Stop,
    progress: Progress | None = None,
    service: ServiceManager | None = None,
) -> None:
    """Run a node on recordings, at the pace of `clock`, to their end; `service`, if there is one, gets reports.

    Raises
    ------
    DeviceError
        If recordings of arrays that the site joins do not belong together.
    UndeliveredError
        If a server has not acknowledged everything.
    """
    pipelines, inputs = make_pipelines(site, recordings, reports_levels=True)
    links = _links(site, name, pipelines, clock, run_id)

    def turn() -> None:
        if service is not None:
            service.turn(links.in_words)

    try:
        with HostWatch() as host:
            for end_ns in _sent(links, pipelines, inputs, clock, stop, host):
                turn()
                if progress is not None:
                    progress(end_ns)
        links.drain(clock, stop, turn)
    finally:
        if service is not None:
            service.stopping()


def with_host(
    messages: Iterable[Message], host: HostWatch, lost_blocks: int = 0, *, sound_server: bool = False
) -> list[Message]:
    """Return messages with the state of this machine in those marks that carry levels.

    Parameters
    ----------
    messages : iterable of Message
    host : HostWatch
    lost_blocks : int
        Blocks of the device that were lost because the machine did not keep up.
    sound_server : bool
        Whether the device is read through a sound server.
    """
    return [
        replace(message, host=host.state(lost_blocks, sound_server=sound_server))
        if isinstance(message, Mark) and message.levels
        else message
        for message in messages
    ]


def send_session(
    site: Site,
    endpoint: str,
    recordings: Sequence[AssignedRecording],
    pace: Clock,
    clock: Clock,
    run_id: str,
    stop: Stop,
    progress: Progress | None = None,
) -> None:
    """Play a recorded session to a server, with its original times, at the pace of the clock `pace`.

    Raises
    ------
    DeviceError
        If recordings of arrays that the site joins do not belong together.
    UndeliveredError
        If no server answers, or the server refuses the sound or has not acknowledged everything.
    """
    pipelines, inputs = make_pipelines(site, recordings, reports_levels=True)
    hello = _hello("replay", pipelines, run_id, is_replay=True)
    link = _link(endpoint, hello, node_keys(site, "replay"), pipelines, clock, Spool())
    link.wait_connected(stop)
    if not (link.connected or link.refused or stop()):
        link.close(bye=False)
        raise UndeliveredError(
            f"expected a server at {endpoint}, got no answer; start it, or correct the address, whose port is that of "
            "server.bind, not of the dashboard"
        )
    lead = _Lead(link, clock)
    end_ns = 0
    for end_ns in _sent(Links([link]), pipelines, inputs, pace, lambda: stop() or link.refused is not None):
        if progress is not None:
            progress(end_ns)
        while (link.pending > MAX_PENDING or lead.exceeds(AHEAD_NS, end_ns)) and not (stop() or link.refused):
            _pause(link, clock)
    while lead.exceeds(END_NS, end_ns) and not (stop() or link.refused):  # the server may still request frames
        _pause(link, clock)
    Links([link]).drain(clock, stop)


class _Lead:
    """The lead of a replay over its server, in recorded time."""

    def __init__(self, link: Link, clock: Clock) -> None:
        self._link = link
        self._clock = clock
        self._settled = link.settled
        self._since_ns = clock.monotonic_ns()

    def exceeds(self, most_ns: int, end_ns: int) -> bool:
        """Return True if more than `most_ns` before `end_ns` is not settled, and the server still makes progress."""
        if self._link.settled != self._settled or self._link.pending:
            self._settled, self._since_ns = self._link.settled, self._clock.monotonic_ns()
        if self._settled is None or end_ns - self._settled * FRAME_NS <= most_ns:
            return False
        return self._clock.monotonic_ns() - self._since_ns < STUCK_NS


def _links(site: Site, name: str, pipelines: Sequence[Pipeline], clock: Clock, run_id: str) -> Links:
    """Return the links to all servers of a node, each with its spool and the arrays that its server gets."""
    config, encode = site.nodes[name], EncodeOnce()
    hello, keys = _hello(name, pipelines, run_id), node_keys(site, name)
    links = [_link(config.server, hello, keys, pipelines, clock, _spool(site, name, name, encode))]
    for number, further in enumerate(config.further_servers, 2):
        # each link is a run of its own: if two addresses are those of one server, it refuses the second link in words
        own = replace(hello, run_id=f"{run_id}-{number}")
        wanted = set(config.arrays if further.arrays is None else further.arrays)
        # a joint array is sent for any of its members
        rates = {each: rate for each, rate in hello.arrays.items() if not wanted.isdisjoint(site.members(each))}
        keys, spool = node_keys(site, name, further.public_key), _spool(site, name, _folder(name, further), encode)
        links.append(_link(further.server, replace(own, arrays=rates), keys, pipelines, clock, spool))
    _warn_of_abandoned_spools(site, name)
    return Links(links)


def _folder(name: str, further: FurtherServer) -> str:
    """Return the name of the spool's folder for a further server; no node can have it as its own name."""
    return f"{name}@{re.sub('[^A-Za-z0-9.-]', '_', further.server.removeprefix('tcp://'))}"


def _warn_of_abandoned_spools(site: Site, name: str) -> None:
    """Log the folders whose server the site file no longer names: their sound is never sent, and stays there."""
    config = site.nodes[name]
    if config.spool.directory is None:
        return
    wanted = {_folder(name, further) for further in config.further_servers}
    for folder in site.file(config.spool.directory).glob(f"{name}@*"):
        if folder.name not in wanted:
            _log.warning("no server of nodes.%s.further_servers gets the frames in %s; delete the folder", name, folder)


def _spool(site: Site, name: str, folder: str, encode: Callable[[Frame], bytes]) -> Spool:
    spool = site.nodes[name].spool
    directory = None if spool.directory is None else site.file(spool.directory) / folder
    kept = Spool(directory, round(spool.max_mb * 1e6), spool.max_age_s, encode)
    if len(kept):
        _log.info("the spool holds %d frames of an earlier run; they are sent now", len(kept))
    return kept


def _hello(name: str, pipelines: Sequence[Pipeline], run_id: str, *, is_replay: bool = False) -> wire.Hello:
    """Return the greeting of a node with all arrays of its pipelines."""
    rates = {array: pipeline.sample_rate_hz for pipeline in pipelines for array in pipeline.arrays}
    return wire.Hello(name, run_id, rates, is_replay)


def _link(
    endpoint: str,
    hello: wire.Hello,
    keys: NodeKeys | None,
    pipelines: Sequence[Pipeline],
    clock: Clock,
    spool: Spool,
) -> Link:
    def backfill(request: BackfillRequest) -> list[Message]:
        return [message for pipeline in pipelines for message in pipeline.backfill(request)]

    return Link(endpoint, hello, clock, keys, spool=spool, backfill=backfill)


def _sent(
    links: Links,
    pipelines: Sequence[Pipeline],
    inputs: Sequence[TimedRecording],
    pace: Clock,
    stop: Stop,
    host: HostWatch | None = None,
) -> Iterator[int]:
    """Send the messages of the pipelines, block by block, with the state of the host; yield the site time reached."""
    for end_ns, batch in paced_messages(pipelines, inputs, pace):
        if stop():
            return
        links.send(batch if host is None else with_host(batch, host))
        yield end_ns


def _pause(link: Link, clock: Clock) -> None:
    clock.sleep_until_ns(clock.now_ns() + WAIT_NS)
    link.service()
