"""The fusion of a site: estimator, parameters and clock offsets. It imports everything that locates."""

from __future__ import annotations

from livessl.core.locate.estimators import ESTIMATORS, Estimator
from livessl.core.stream.clock_offsets import ClockOffsets
from livessl.core.stream.correlation_cache import Each
from livessl.core.stream.fusion import ANSWER_S, Fusion, FusionParameters
from livessl.core.stream.segmenter import RECENT_S
from livessl.site.build.grid import search_grid
from livessl.site.models import Site


def make_clock_offsets(site: Site) -> ClockOffsets:
    """Return clock offsets, all still unknown: one clock for each node, and one for each array without a node."""
    return ClockOffsets({spec.name: site.node_of(spec.name) or spec.name for spec in site.processed}, site.c_m_s)


def make_estimator(site: Site, method: str | None = None) -> Estimator:
    """Return a new estimator of a site's arrays: the site's method, or another of `METHODS`."""
    return ESTIMATORS[method or site.fusion.method](site.processed, search_grid(site), site.c_m_s)


def make_fusion(
    site: Site,
    method: str | None = None,
    *,
    updates: bool = True,
    live: bool = False,
    clock_offsets: ClockOffsets | None = None,
    each: Each | None = None,
) -> Fusion:
    """Return a new fusion of this site's arrays.

    Parameters
    ----------
    site : Site
    method : str or None
        One of `METHODS`; None for the site's own.
    updates : bool
        Publish updates while an event lasts.
    live : bool
        True for live sound: wait less long for requested frames, and leave out updates that are overdue.
    clock_offsets : ClockOffsets or None
        Offsets that are known already; None to begin with unknown ones.
    each : Each or None
        Parallel `for_each` that correlates the arrays' frames; None for a plain loop.
    """
    f, a = site.fusion, site.activity
    parameters = FusionParameters(
        deadline_s=f.deadline_s,
        answer_s=ANSWER_S if live else RECENT_S,
        window_s=f.window_s,
        update_s=f.update_s,
        max_event_s=f.max_event_s,
        min_arrays=f.min_arrays,
        sources=f.sources,
        live_sources=f.live_sources,
        threshold=a.threshold,
        pre_roll_s=a.pre_roll_s,
        hang_over_s=a.hang_over_s,
    )
    return Fusion(
        site.site,
        site.processed,
        make_estimator(site, method),
        parameters,
        updates=updates,
        newest_only=live,
        clock_offsets=make_clock_offsets(site) if clock_offsets is None else clock_offsets,
        each=each,
    )
