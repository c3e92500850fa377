"""Words alerts: their JSON, title and text, and the permanent key by which copies are recognized."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Final

from livessl.clock import utc_text
from livessl.core.commission.finding import Finding
from livessl.core.types import Status
from livessl.server.alerts.rules import Match
from livessl.server.api.encode import JsonObject
from livessl.server.signed_links import SignedLinks
from livessl.site.alert_models import LinksConfig
from livessl.site.models import Site

KEY_PREFIX: Final = "alert_"
KEY_DIGITS: Final = 32
"""Hexadecimal digits of a key: 128 bits of SHA-256, which no two alerts share by chance."""


class AlertMessages:
    """Makes the alerts of a site.

    Parameters
    ----------
    site : Site
    url : str
        Address of the server for people, without a slash at its end.
    """

    def __init__(self, site: Site, url: str) -> None:
        self._site = site.site
        self._url = url
        self._has_clips = site.server.clips is not None

    def key(self, rule: str, subject: str) -> str:
        """Return the key of a rule's alert.

        The key depends on the site, the rule and the subject alone, so an alert that is raised again after a crash has
        the same key.

        Parameters
        ----------
        rule : str
        subject : str
            Id of the event of the alert, or a text that names another subject.
        """
        digest = hashlib.sha256("\0".join((self._site, rule, subject)).encode()).hexdigest()
        return KEY_PREFIX + digest[:KEY_DIGITS]

    def key_of_change(self, rule: str, change: JsonObject, time_ns: int) -> str:
        """Return the key of a rule's alert about a change of a track in a zone at `time_ns`, a site time."""
        return self.key(rule, _change_subject(change, time_ns))

    def of_event(self, rule: str, event: JsonObject, match: Match, count: int, raised_ns: int) -> JsonObject:
        """Return the alert about an event, the last of the `count` events for which the rule waits."""
        zones = [{"name": name, "probability": round(value, 4)} for name, value in match.zones.items()]
        return {
            **self._head(rule, event["id"], raised_ns),
            "time_utc": event["time_utc"],
            "text": _event_text(event, match.zones, count),
            "link": f"{self._url}/#event={event['id']}",
            "picture": self._picture(rule, event["id"]),
            "clips": f"{self._url}/api/v1/events/{event['id']}/clips" if self._has_clips else None,
            "zones": [zone["name"] for zone in zones],
            "membership": zones,
            "count": count,
            "event": event,
            "array": None,
            "finding": None,
            "change": None,
        }

    def of_change(self, rule: str, change: JsonObject, time_ns: int, raised_ns: int) -> JsonObject:
        """Return the alert about a track that enters, leaves, or loiters in a zone."""
        subject = _change_subject(change, time_ns)
        inside = {"name": change["zone"], "probability": change["probability"]}
        return {
            **self._of_condition(rule, subject, time_ns, raised_ns, _change_text(change)),
            "picture": self._picture(rule, subject),
            "zones": change["zones"],
            "membership": [inside],
            "change": change,
        }

    def of_array(self, rule: str, array: JsonObject, since_ns: int, raised_ns: int) -> JsonObject:
        """Return the alert about an array that has been in a bad state since `since_ns`, a site time."""
        name, state, reason = array["name"], array["state"], array["reason"]
        text = f"array {name!r} is {state}" + (f": {reason}" if reason else "")
        subject = f"array {name} {state} {since_ns}"
        seen = {"name": name, "state": state, "reason": reason}
        return self._of_condition(rule, subject, since_ns, raised_ns, text, array=seen)

    def of_finding(self, rule: str, finding: Finding, about: str, since_ns: int, raised_ns: int) -> JsonObject:
        """Return the alert about a fault of the set-up that has been found since `since_ns`, a site time.

        The text `about` names the fault in the alert's key.
        """
        subject = f"finding {about} {since_ns}"
        text = f"{finding.message}; {finding.cure}"
        seen = {"kind": "finding", **asdict(finding)}
        return self._of_condition(rule, subject, since_ns, raised_ns, text, finding=seen)

    def _of_condition(
        self, rule: str, subject: str, since_ns: int, raised_ns: int, text: str, **seen: JsonObject
    ) -> JsonObject:
        return {
            **self._head(rule, subject, raised_ns),
            "time_utc": utc_text(since_ns),
            "text": text,
            "link": f"{self._url}/",
            "picture": None,
            "clips": None,
            "zones": [],
            "membership": [],
            "count": 1,
            "event": None,
            "array": seen.get("array"),
            "finding": seen.get("finding"),
            "change": None,
        }

    def _picture(self, rule: str, subject: str) -> str:
        return f"{self._url}/api/v1/alerts/{self.key(rule, subject)}/picture.png"

    def _head(self, rule: str, subject: str, raised_ns: int) -> JsonObject:
        return {
            "kind": "alert",
            "key": self.key(rule, subject),
            "rule": rule,
            "site": self._site,
            "raised_utc": utc_text(raised_ns),
        }


def with_links(alert: JsonObject, links: SignedLinks, config: LinksConfig, url: str) -> JsonObject:
    """Return an alert with links that open its picture and its recording without a token until they expire.

    Links are signed at delivery and never stored, because viewers may read stored alerts but not open recordings.

    Parameters
    ----------
    alert : JsonObject
    links : SignedLinks
    config : LinksConfig
    url : str
        Address of the server for people, without a slash at its end.
    """
    event = alert["event"]
    paths: dict[str, str] = {}
    if "picture" in config.of and alert.get("picture") is not None:
        paths["picture"] = f"/api/v1/alerts/{alert['key']}/picture.png"
    if "clip" in config.of and alert.get("clips") is not None and event["status"] == Status.LOCATED:
        paths["clip"] = f"/api/v1/events/{event['id']}/clips/best"
    signed = {name: links.sign(path, config.lifetime_s) for name, path in paths.items()}
    if not signed:
        return {**alert, "links": None}
    addresses = {name: url + signed[name][0] if name in signed else None for name in ("picture", "clip")}
    until_ns = min(expires_ns for _, expires_ns in signed.values())
    return {**alert, "links": {**addresses, "until_utc": utc_text(until_ns)}}


def title(alert: JsonObject) -> str:
    """Return a short heading for mails and chats."""
    return f"livessl {alert['site']}: {alert['rule']}"


def body(alert: JsonObject) -> str:
    """Return the text of a mail or chat message: subject, time, links, and the key, which repeated messages share."""
    lines = [alert["text"], alert["time_utc"] or "at an unknown time", alert["link"]]
    links = alert.get("links")
    if links is not None:
        lines += [f"{name}: {links[name]}" for name in ("picture", "clip") if links[name] is not None]
        lines.append(f"whoever has these links can open them until {links['until_utc']}")
    return "\n".join((*lines, alert["key"]))


def _event_text(event: JsonObject, zones: Mapping[str, float], count: int) -> str:
    """Return the event's position, zones and confidence in one line."""
    x, y, z = event["position_m"]
    std_m = _total_std_m(event["covariance_m2"])
    what = "sound" if count == 1 else f"{count} sounds, the last"
    if event["status"] != "located":
        what += " (direction only)"
    where = f" at ({x:.2f}, {y:.2f}, {z:.2f}) m, uncertain by {std_m:.2f} m"
    inside = "".join(f", in zone {name!r} with probability {value:.2f}" for name, value in zones.items())
    level = "" if event["level_dbfs"] is None else f", {event['level_dbfs']:.1f} dBFS"
    return f"{what}{where}{inside}, confidence {event['confidence']:.2f}{level}, {event['duration_s']:.2f} s long"


def _change_subject(change: JsonObject, time_ns: int) -> str:
    """Return the subject of an alert about a change: changes of one kind, track, zone and time have the same text."""
    return f"track {change['track_id']} {change['change']} {change['zone']} {time_ns}"


def _change_text(change: JsonObject) -> str:
    """Return the change of a track, its zone and its stay in one line."""
    done = {"enter": "has entered", "leave": "has left", "loiter": "stays in"}[change["change"]]
    stay = "" if change["change"] == "enter" else f" after {change['stay_s']:.1f} s"
    x, y, z = change["position_m"]
    return f"track {change['track_id']} {done} zone {change['zone']!r}{stay}, at ({x:.2f}, {y:.2f}, {z:.2f}) m"


def _total_std_m(covariance_m2: Any) -> float:
    """Return the square root of the trace: the standard deviation over all three axes together, in metres."""
    return math.sqrt(sum(covariance_m2[axis][axis] for axis in range(3)))
