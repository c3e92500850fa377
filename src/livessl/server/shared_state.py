"""State of a running server that most of its parts share; none of it knows them."""

from __future__ import annotations

from dataclasses import dataclass

from livessl.clock import Clock
from livessl.server.latency import Latency
from livessl.server.maps import Maps
from livessl.server.overload import Overload
from livessl.server.site_time import SiteTime
from livessl.site.models import Site


@dataclass(frozen=True, slots=True)
class SharedState:
    """The state of a server that most of its parts are given.

    Parameters
    ----------
    site : Site
        The site as it was when the server started.
    clock : Clock
    site_time : SiteTime
        Knows the time of the sound, and whether a replay runs.
    latency : Latency
        Has the delays of the stages between sound and message.
    maps : Maps
        Draws the power maps that someone watches.
    overload : Overload
        Knows how busy the server is, and what it sheds.
    """

    site: Site
    clock: Clock
    site_time: SiteTime
    latency: Latency
    maps: Maps
    overload: Overload
