"""Makes the pipeline of a device, or of a recording in its place, from the site. It imports nothing that locates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from livessl.core.stream.activity import ActivityParameters
from livessl.core.stream.pipeline import Pipeline, Wiring
from livessl.site.models import Site


def activity_parameters(site: Site) -> ActivityParameters:
    """Return the parameters of the activity detection, as the core takes them."""
    activity = site.activity
    return ActivityParameters(
        threshold=activity.threshold,
        release_s=activity.release_s,
        floor_window_s=activity.floor_window_s,
        floor_factor=activity.floor_factor,
        min_power=10.0 ** (activity.min_level_dbfs / 10.0),
        pre_roll_s=activity.pre_roll_s,
        hang_over_s=activity.hang_over_s,
    )


def make_pipeline(
    site: Site, channels: Mapping[str, Sequence[int]], sample_rate_hz: float, *, reports_levels: bool = False
) -> Pipeline:
    """Return the pipeline of the arrays that share one device's clock.

    Parameters
    ----------
    site : Site
    channels : mapping of array name to channels
        Device channels counted from 1, in the order of the array's microphones. Arrays that the site joins are
        processed as one.
    sample_rate_hz : float
        Nominal rate of the device.
    reports_levels : bool
        Whether marks carry the levels of the channels.
    """
    wirings = [
        Wiring(site.array(name), np.array(numbers) - 1) for name, numbers in site.joined_channels(channels).items()
    ]
    return Pipeline(wirings, sample_rate_hz, activity_parameters(site), reports_levels=reports_levels)
