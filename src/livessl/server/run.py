"""The state of one live run or one replay; a live run continues where the one before a restart stopped."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from livessl.core.stream.clock_offsets import ClockOffsets
from livessl.core.stream.correlation_cache import ForEach
from livessl.core.stream.final_pass import TwoPassFusion
from livessl.server.api.encode import Messages
from livessl.server.store import Finalized
from livessl.server.zones.zone_map import ZoneMap
from livessl.site.build.fusion import make_clock_offsets, make_two_pass_fusion
from livessl.site.models import Site


@dataclass(slots=True)
class Run:
    """The state of one run.

    Parameters
    ----------
    site : Site
    fusion : TwoPassFusion
    clock_offsets : ClockOffsets
        What the fusion learns of the arrays' clocks.
    messages : Messages or None
        Encodes what is published; None before `begin`. A replay begins at the time of its first message.
    """

    site: Site
    fusion: TwoPassFusion
    clock_offsets: ClockOffsets
    messages: Messages | None = None

    def begin(self, origin_ns: int, zones: Callable[[], ZoneMap]) -> None:
        """Start to encode messages, with their `start_s` counted from `origin_ns` of site time."""
        self.messages = Messages(self.site, origin_ns, utc=True, zones=zones)


def live_run(site: Site, done: Finalized, for_each: ForEach) -> Run:
    """Return a live run of all arrays, which continues where the final pass of the live run before it stopped."""
    return _run(site, [spec.name for spec in site.processed], done, for_each, live=True)


def replay_run(site: Site, arrays: Iterable[str], for_each: ForEach) -> Run:
    """Return the replay of a recording of these arrays."""
    return _run(site, arrays, Finalized(None, None), for_each, live=False)


def _run(site: Site, arrays: Iterable[str], done: Finalized, for_each: ForEach, *, live: bool) -> Run:
    clock_offsets = make_clock_offsets(site)
    if done.clocks is not None:
        clock_offsets.restore(done.clocks)
    fusion = make_two_pass_fusion(site, arrays, done.until, live=live, clock_offsets=clock_offsets, for_each=for_each)
    return Run(site, fusion, clock_offsets)
