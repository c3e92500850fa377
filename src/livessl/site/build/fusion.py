"""Makes the fusion of a site: estimator, parameters, clock offsets. It imports everything that locates."""

from __future__ import annotations

from collections.abc import Iterable

from livessl.core.locate.estimator import Estimator, create
from livessl.core.stream.clock_offsets import ClockOffsets
from livessl.core.stream.correlation_cache import ForEach
from livessl.core.stream.final_pass import TwoPassFusion
from livessl.core.stream.fusion import Fusion, Role
from livessl.core.stream.parameters import BACKFILL_WAIT_S, FusionParameters
from livessl.core.stream.segmenter import RECENT_S
from livessl.core.stream.site_state import ArraySetUp, SiteState
from livessl.errors import ConfigError, Fault
from livessl.site.build.grid import search_grid
from livessl.site.build.pipeline import activity_parameters
from livessl.site.models import Site


def make_clock_offsets(site: Site) -> ClockOffsets:
    """Return clock offsets, all still unknown: one clock for each node, and one for each array without a node."""
    return ClockOffsets({spec.name: site.node_of(spec.name) or spec.name for spec in site.processed}, site.c_m_s)


def make_estimator(site: Site, method: str | None = None) -> Estimator:
    """Return a new estimator of a site's arrays, by the site's method or by another one.

    Raises
    ------
    ConfigError
        If there is no such method, or it cannot be imported.
    """
    try:
        return create(method or site.fusion.method, site.processed, search_grid(site), site.c_m_s)
    except ValueError as error:
        raise ConfigError([Fault("fusion.method" if method is None else "method", str(error))]) from error


def make_fusion(
    site: Site,
    method: str | None = None,
    *,
    updates: bool = True,
    corrects_clocks: bool = True,
    clock_offsets: ClockOffsets | None = None,
) -> Fusion:
    """Return a single pass over this site's recordings.

    Parameters
    ----------
    site : Site
    method : str, optional
        Registered name, or `MODULE:NAME`; the site's own by default.
    updates : bool
        Whether windows are located while a sound goes on.
    corrects_clocks : bool
        Whether the offsets of the arrays' clocks are learned and corrected.
    clock_offsets : ClockOffsets, optional
        What is known already of the arrays' clocks.
    """
    if corrects_clocks and clock_offsets is None:
        clock_offsets = make_clock_offsets(site)
    return Fusion(_site_state(site, method, RECENT_S, clock_offsets), Role(updates=updates))


def make_two_pass_fusion(
    site: Site,
    arrays: Iterable[str],
    settled: int | None = None,
    *,
    live: bool = False,
    clock_offsets: ClockOffsets | None = None,
    for_each: ForEach | None = None,
) -> TwoPassFusion:
    """Return the early and the final pass of this site.

    Parameters
    ----------
    site : Site
    arrays : iterable of str
        Arrays whose sound is awaited.
    settled : int or None
        Frame index before which all results are final already.
    live : bool
        Whether the sound is live, so that the early pass has to keep up with it.
    clock_offsets : ClockOffsets, optional
        What is known already of the arrays' clocks.
    for_each : ForEach, optional
        Correlates several arrays in parallel.
    """
    if clock_offsets is None:
        clock_offsets = make_clock_offsets(site)
    state = _site_state(site, None, BACKFILL_WAIT_S if live else RECENT_S, clock_offsets, for_each)
    return TwoPassFusion(state, arrays, settled, newest_only=live)


def make_array_set_up(site: Site, for_each: ForEach | None = None) -> ArraySetUp:
    """Return the arrays of a site and their estimator, for a fusion that goes on with them."""
    return ArraySetUp.of(site.processed, make_estimator(site), for_each)


def _site_state(
    site: Site,
    method: str | None,
    backfill_wait_s: float,
    clock_offsets: ClockOffsets | None,
    for_each: ForEach | None = None,
) -> SiteState:
    f = site.fusion
    parameters = FusionParameters(
        deadline_s=f.deadline_s,
        backfill_wait_s=backfill_wait_s,
        window_s=f.window_s,
        update_s=f.update_s,
        max_event_s=f.max_event_s,
        min_arrays=f.min_arrays,
        sources=f.sources,
        live_sources=f.live_sources,
        activity=activity_parameters(site),
    )
    return SiteState(
        site.site,
        site.processed,
        make_estimator(site, method),
        parameters,
        clock_offsets=clock_offsets,
        for_each=for_each,
        free_axes=search_grid(site).free_axes,
    )
