"""Decides whether the schedule of a rule is open at an instant, by the wall clock of the site's time zone.

`rules` asks it before a rule alerts; the spans are parsed and checked in `site/alert_models.py`.
"""

from __future__ import annotations

from collections.abc import Sequence

from livessl.clock import local_time
from livessl.site.alert_models import DAYS, ScheduleSpan


def is_open(schedule: Sequence[ScheduleSpan], time_ns: int, zone: str | None) -> bool:
    """Return whether a schedule holds at an instant; a schedule without spans always holds.

    A span over midnight belongs to the day on which it begins: `days: [fri], begin: "22:00", end: "06:00"` lasts until
    Saturday morning.
    """
    if not schedule:
        return True
    now = local_time(time_ns, zone)
    today, yesterday = DAYS[now.weekday], DAYS[now.weekday - 1]
    for span in schedule:
        if span.begin < span.end:
            if today in span.days and span.begin <= now.minute < span.end:
                return True
        elif (today in span.days and now.minute >= span.begin) or (yesterday in span.days and now.minute < span.end):
            return True
    return False
