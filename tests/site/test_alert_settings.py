"""The site file's `alerts`: each fault is one sentence with its line, and warnings say what can be lost."""

from __future__ import annotations

from typing import Any

import pytest

from livessl.errors import ConfigError
from livessl.site.models import Site
from small_site import Changes, site_of

RUN = {"run": {"command": ["true"]}}


def load(alerts: dict[str, Any], changes: Changes | None = None) -> Site:
    return site_of({"alerts": alerts, **(changes or {})})


def events(**condition: Any) -> dict[str, Any]:
    return {"rules": {"door": {"events": condition}}}


def span(**keys: Any) -> dict[str, Any]:
    return {"rules": {"door": {"events": {}, "schedule": [keys]}}}


def action(**keys: Any) -> dict[str, Any]:
    return {"actions": {"guard": keys}}


@pytest.mark.parametrize(
    ("alerts", "fault"),
    [
        (
            {"rules": {"door": {}}},
            "alerts.rules.door: expected exactly one of events, tracks, arrays, findings; got none",
        ),
        ({"rules": {"door": {"events": {}, "arrays": {}}}}, "findings; got events, arrays"),
        ({"rulez": {}}, "alerts.rulez: unknown key 'rulez'; did you mean 'rules'?"),
        ({"rules": {"a/b": {"events": {}}}}, "alerts.rules.a/b: expected a name of 1 to 64 letters, digits"),
        (events(zones=["dor"]), "events.zones: expected one of the zones door, got 'dor'; correct the name"),
        (events(statuses=["refused"]), "refused events never alert; remove refused"),
        (events(statuses=["lost"]), "expected 'located' or 'direction-only', got 'lost'"),
        (events(count=3), "expected count above 1 and within_s together, got count alone; add the other one"),
        (events(within_s=3), "got within_s alone; add the other one"),
        (events(probability=1), "probability: expected a value less than 1, got 1"),
        (events(min_confidnce=1), "unknown key 'min_confidnce'; did you mean 'min_confidence'?"),
        (span(begin="25:00"), 'begin: expected a time of day from "00:00" to "24:00", got \'25:00\''),
        (span(begin="10:60"), "got '10:60'"),
        (span(begin=8), 'expected a time of day from "00:00" to "24:00", got 8; write "08:00"'),
        (span(end=22), 'got 22; write "22:00"'),
        (span(end=59), "got 59"),
        (
            {"rules": {"x": {"events": {}, "actions": ["run", "run"]}}, "actions": RUN},
            "expected each action once, got 'run' twice; remove one",
        ),
        (span(begin="08:00", end="08:00"), "expected begin and end to differ"),
        (span(days=["monday"]), "expected 'mon', 'tue', 'wed', 'thu', 'fri', 'sat' or 'sun', got 'monday'"),
        ({"timezone": "Mars/Crater"}, "expected a time zone such as Europe/Berlin or UTC, got 'Mars/Crater'"),
        ({"rules": {"x": {"arrays": {"names": ["west"]}}}}, "expected one of the arrays north, south, got 'west'"),
        ({"rules": {"x": {"events": {}, "actions": ["ran"]}}, "actions": RUN}, "alerts.actions, run, got 'ran'"),
        (action(), "expected exactly one of webhook, mqtt, command, apprise; got none"),
        (action(webhook={"url": "ftp://x/"}), "expected http://HOST/PATH or https://HOST/PATH, got 'ftp://x/'"),
        (action(webhook={"url": "http://x:99999/"}), "got 'http://x:99999/'"),
        (action(webhook={"url": "http://x/\r\nHost: y"}), "expected http://HOST/PATH"),
        (action(webhook={"url": "http://a:b@x/"}), "expected an address without user and password"),
        (action(mqtt={"topic": "yard/#"}), "expected a topic without '#'"),
        (action(mqtt={"password": "file"}), "password needs username; add it"),
        (action(command=[]), "expected at least 1 item"),
        ({"links": {"lifetime_s": 5}}, "links.lifetime_s: expected a value greater than or equal to 60, got 5"),
        ({"links": {"of": ["clips"]}}, "expected 'picture' or 'clip', got 'clips'"),
        (span(days=[]), "days: expected at least 1 item, got none; leave the key out for the default"),
    ],
)
def test_fault(alerts: dict[str, Any], fault: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(alerts)
    assert fault in str(caught.value)
    assert len(caught.value.faults) == 1


def test_all_faults_are_found_at_once() -> None:
    with pytest.raises(ConfigError) as caught:
        load({**events(zones=["dor"]), "actions": {"guard": {"webhook": {"url": "x"}}}, "timezone": "Mars"})
    assert len(caught.value.faults) == 2  # the section is not compared with others before it is valid itself


def test_time_of_day_without_quotes_is_what_it_looks_like() -> None:
    """YAML reads 22:00 as the number 1320."""
    spans = load(span(begin=22 * 60, end="6:30")).alerts.rules["door"].schedule
    assert (spans[0].begin, spans[0].end) == (1320, 390)


def test_site_without_alerts_has_none_and_no_warning() -> None:
    site = site_of()
    assert (site.alerts.rules, site.warnings) == ({}, ())


def test_warnings_say_what_can_be_lost() -> None:
    rules = {"door": {"events": {}, "actions": ["run"]}}
    kept = {"server.events_db": "events.sqlite"}
    assert load({"rules": rules, "actions": RUN}, kept).warnings == ()
    [killed, restart] = load({"rules": rules, "actions": RUN}).warnings
    assert killed.startswith("alerts: without server.events_db")
    assert restart.startswith("alerts: a restart forgets")
    assert len(load({"rules": rules, "actions": RUN, "outbox": "alerts.sqlite"}).warnings) == 1
    everywhere = {
        **kept,
        "server.http": {"host": "0.0.0.0", "tokens": "tokens.yaml", "certificate": "a", "private_key": "b"},
    }
    [links] = load({"rules": rules, "actions": RUN}, everywhere).warnings
    assert links.startswith("alerts.url: links in alerts name 0.0.0.0")
    assert load({"rules": rules, "actions": RUN, "url": "https://ears.example.org/"}, everywhere).warnings == ()
    [unused] = load({"rules": {"door": {"events": {}}}, "actions": RUN}, kept).warnings
    assert unused == "alerts.actions.run: no rule takes this action; name it in the actions of a rule"
