"""The rules and actions of one site file, ready to judge and deliver; a reload replaces them as a whole."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from livessl.clock import Clock
from livessl.server.alerts.actions import ActionSetting, make_action
from livessl.server.alerts.delivery import Deliverer
from livessl.server.alerts.evidence import Evidence
from livessl.server.alerts.history import DryRuns
from livessl.server.alerts.message import AlertMessages, with_links
from livessl.server.alerts.outbox import Outbox
from livessl.server.alerts.rule_runner import RuleRunner
from livessl.server.event_traces import EventTraces
from livessl.server.forwarding.tile import Tile
from livessl.server.signed_links import SignedLinks
from livessl.server.store import Store
from livessl.server.zones.zone_map import ZoneMap
from livessl.site.alert_checks import outbox_file
from livessl.site.alert_models import AlertsConfig
from livessl.site.models import Site

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Parts of the server that rules and actions need beside the site file.

    Parameters
    ----------
    clock : Clock
    store : Store
    zones : callable
        Returns the zones that are in force.
    url : str
        Address of the server, for links, unless the site file gives another one.
    evidence : Evidence
        Pictures and clips of alerts.
    traces : EventTraces or None
        Adds spans of alerts; None if nothing is traced.
    links : SignedLinks or None
        Signs links for people without a token; None if every reader has one.
    """

    clock: Clock
    store: Store
    zones: Callable[[], ZoneMap]
    url: str
    evidence: Evidence
    traces: EventTraces | None = None
    links: SignedLinks | None = None


class AlertsInForce:
    """Rules with their states, and a deliverer for each action.

    Parameters
    ----------
    site : Site
    outbox : Outbox
    around : Surroundings

    Raises
    ------
    ConfigError
        If an action cannot be made; then the outbox is as it was.
    OutboxError
        If the outbox cannot be used.
    """

    def __init__(self, site: Site, outbox: Outbox, around: Surroundings) -> None:
        self.config: AlertsConfig = site.alerts
        """Rules and actions as the site file has them."""
        self.outbox = outbox
        """Alerts, deliveries and the rules' states."""
        kinds = {rule.kind for rule in self.config.rules.values()}
        self.judges_events = "events" in kinds
        self.judges_early = any(rule.events and rule.events.early for rule in self.config.rules.values())
        self.judges_tracks = "tracks" in kinds
        self.judges_conditions = not kinds.isdisjoint(("arrays", "findings"))
        base = self.config.url or around.url + site.server.http.root_path
        self.deliverers = {name: _deliverer(name, site, around, outbox, base) for name in self.config.actions}
        """The deliverer of each action, by name."""
        self.dry_runs = DryRuns(self.config, around.store, around.zones, Tile.of(site))
        """Tries rules on the history."""
        self.runner = RuleRunner(site, around.clock, outbox, AlertMessages(site, base), around.zones)
        """The rules with their states."""
        if not self.judges_events:  # rules that come back must not judge the time between
            outbox.forget_judged(site.site)
        if gone := outbox.abandon(self.deliverers):
            _log.warning("%d alerts waited for actions that the site file no longer has; they are dead letters", gone)


def outbox_path(site: Site) -> Path | None:
    """Return the file of the outbox; None for memory. A site without rules uses the one that it had before."""
    path = outbox_file(site)
    return path if path is not None and (site.alerts.rules or path.exists()) else None


def _deliverer(name: str, site: Site, around: Surroundings, outbox: Outbox, url: str) -> Deliverer:
    alerts, config = site.alerts, site.alerts.actions[name]
    rules = [rule for rule, each in alerts.rules.items() if name in each.actions]
    alike = {other for other, each in alerts.actions.items() if each.kind == config.kind}
    taken = {rule for rule, each in alerts.rules.items() if not alike.isdisjoint(each.actions)}
    others = sorted((alerts.rules.keys() | outbox.states().keys()) - taken)
    action = make_action(ActionSetting(name, config, site, around.clock, rules, others, url, around.evidence))
    links = around.links
    complete = None if links is None else partial(with_links, links=links, config=alerts.links, url=url)
    return Deliverer(name, config, action, outbox, around.clock, around.traces, complete)
