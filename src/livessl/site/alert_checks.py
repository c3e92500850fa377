"""Checks `alerts` of the site file against the rest: unknown zones and actions, settings that lose alerts."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from livessl.site.alert_models import AlertRule
from livessl.site.findings import unknown_array
from livessl.site.history_place import history_place
from livessl.site.models import Site
from livessl.site.place import Finding, Place

OUTBOX: Final = "alerts.sqlite"
"""Name of the outbox where the site file does not give one; it lies beside `server.events_db`."""

LINK_SECRET: Final = "links.secret"  # noqa: S105 - the name of a file
"""Name of the file, beside the outbox, with the secret that signs links."""

_NAME: Final = re.compile(r"[A-Za-z0-9._-]{1,64}")


def outbox_file(site: Site) -> Path | None:
    """Return the file of what alerts must not forget; None keeps it in memory."""
    if site.alerts.outbox is not None:
        return site.file(site.alerts.outbox)
    place = history_place(site)
    return place.with_name(OUTBOX) if isinstance(place, Path) else None


def link_secret_file(site: Site) -> Path | None:
    """Return the file of the secret that signs links; None keeps it in memory, as long as the alerts are kept."""
    outbox = outbox_file(site)
    return None if outbox is None else outbox.with_name(LINK_SECRET)


def alert_faults(site: Site) -> Iterator[Finding]:
    """Yield names in rules that nothing in the file has, and names that cannot be part of an address."""
    for section, names in (("rules", site.alerts.rules), ("actions", site.alerts.actions)):
        for name in names:
            if not _NAME.fullmatch(name):
                yield (
                    ("alerts", section, name),
                    "expected a name of 1 to 64 letters, digits, '.', '_' or '-'; rename it",
                )
    processed = [spec.name for spec in site.processed]
    for name, rule in site.alerts.rules.items():
        here: Place = ("alerts", "rules", name)
        yield from (((*here, rule.kind, "zones"), what) for what in _zone_faults(site, rule))
        for array in () if rule.arrays is None else rule.arrays.names:
            if array not in processed:
                yield (*here, "arrays", "names"), unknown_array(array, processed)
        for action in rule.actions:
            if action not in site.alerts.actions:
                yield (
                    (*here, "actions"),
                    f"expected one of alerts.actions, {', '.join(site.alerts.actions) or '(there are none)'}, got "
                    f"{action!r}; correct the name or add the action",
                )
        twice = next((action for action in rule.actions if rule.actions.count(action) > 1), None)
        if twice is not None:
            yield (*here, "actions"), f"expected each action once, got {twice!r} twice; remove one"


def _zone_faults(site: Site, rule: AlertRule) -> Iterator[str]:
    zones = site.all_zones
    for name in rule.zones:
        zone = zones.get(name)
        if zone is None:
            yield (
                f"expected one of the zones {', '.join(zones) or '(there are none)'}, got {name!r}; correct the name "
                "or add the zone"
            )
        elif zone.exclude:
            yield f"zone {name!r} is excluded, and nothing there alerts; remove it, or its exclude"
        elif rule.tracks is not None and "loiter" in rule.tracks.changes and zone.loiter_s is None:
            yield f"zone {name!r} does not say how long loitering is; add loiter_s to it"


def alert_warnings(site: Site) -> Iterator[str]:
    """Yield settings with which alerts can be lost, or never come."""
    if site.alerts.rules and site.server.events_db is None:
        yield (
            "alerts: without server.events_db, alerts about events of the moment at which a server is killed are lost, "
            "and rules can be tried on few events only; set it"
        )
    if site.alerts.rules and outbox_file(site) is None:
        yield "alerts: a restart forgets what is not delivered, and what is armed; set alerts.outbox"
    if site.alerts.rules and site.alerts.url is None and site.server.http.host in ("0.0.0.0", "::"):  # noqa: S104
        yield (
            f"alerts.url: links in alerts name {site.server.http.host}, which no browser can open; set it to the "
            "address under which people reach this server"
        )
    if "clip" in site.alerts.links.of and site.server.clips is None:
        yield "alerts.links.of: this site keeps no clips, so that no alert has a link to one; set server.clips"
    used = {action for rule in site.alerts.rules.values() for action in rule.actions}
    for name in site.alerts.actions:
        if name not in used:
            yield f"alerts.actions.{name}: no rule takes this action; name it in the actions of a rule"
