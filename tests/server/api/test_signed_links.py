"""Signed links: what they open without a token, for how long, and what ends them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from alert_desk import PATIENT, after, alert_site, encoded, sound
from clip_desk import recordings
from livessl.clock import UnpacedClock, utc_ns
from livessl.core.stream.final_pass import FinalResults
from livessl.schema.alerts import OpenLinks
from livessl.server.alerts.message import body, with_links
from livessl.server.api.encode import JsonObject, Messages
from livessl.server.app import Server
from livessl.server.clips.folder import ClipFolder
from livessl.server.signed_links import SignedLinks, Verdict
from livessl.site.alert_models import LinksConfig
from livessl.site.models import Site
from livessl.site.tokens import Role, add_token
from small_site import HANG_S, Changes, running_server, wait_until
from webhook_receiver import Receiver, running_receiver

NOW_NS = 1_767_225_600_000_000_000
SOUND = b"fLaC" + bytes(range(256))


@dataclass
class Desk:
    """A server with tokens that has alerted about an event with a recording, and who was told."""

    server: Server
    folder: Path
    receiver: Receiver
    tokens: dict[str, str]

    def ask(self, link: str, method: str = "GET", role: str | None = None, **more: Any) -> httpx.Response:
        """Open a link, as a whole address or as a path."""
        url = link if link.startswith("http") else f"{self.server.url}{link}"
        headers = {} if role is None else {"Authorization": f"Bearer {self.tokens[role]}"}
        return httpx.request(method, url, headers=headers, timeout=HANG_S, **more)

    def status(self, link: str, method: str = "GET", role: str | None = None) -> int:
        return self.ask(link, method, role).status_code

    def alerted(self, event_id: str) -> JsonObject:
        """The alert about an event as the receiver got it."""
        return next(each.alert for each in self.receiver.accepted if each.alert["event"]["id"] == event_id)

    def alert_about(self, number: int) -> JsonObject:
        """Let an event with a recording alert."""
        event = sound(number)
        ClipFolder(self.folder / "clips").put(event.id, _recording)
        messages = Messages(self.server.parts.site, 0, utc=True)
        self.server.parts.event_log.add_final(FinalResults((event,), after(event)), messages, {})
        told = self.receiver.accepted
        wait_until(lambda: any(each.alert["event"]["id"] == event.id for each in told), "the alert")
        return self.alerted(event.id)


_recording = recordings(NOW_NS, {"enhanced.flac": SOUND})


@contextmanager
def running(site: Site) -> Iterator[Server]:
    """Run a server, and wait until it has looked which recordings there are: it deletes those that are unfinished."""
    ClipFolder(site.directory / "clips").put("small-0", _recording)
    with running_server(site) as server:
        clips = server.parts.clips
        assert clips is not None
        wait_until(lambda: clips.folder.figures.count == 1, "the recordings that there are")
        yield server


def linking_site(folder: Path, url: str, changes: Changes | None = None, **alerts: Any) -> Site:
    return alert_site(
        folder,
        {
            "server.events_db": "events.sqlite",
            "server.clips": {"folder": "clips", "max_age_days": None},
            **(changes or {}),
        },
        actions={"guard": {**PATIENT, "webhook": {"url": url}}},
        rules={"door": {"events": {"zones": ["door"]}, "hold_off_s": 0, "actions": ["guard"]}},
        **alerts,
    )


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Desk]:
    folder = tmp_path_factory.mktemp("site")
    tokens = {str(role): add_token(folder / "tokens.yaml", str(role), str(role)) for role in Role}  # type: ignore[arg-type]
    with running_receiver() as receiver:
        links = {"of": ["picture", "clip"], "lifetime_s": 3600}
        site = linking_site(folder, receiver.url, {"server.http.tokens": "tokens.yaml"}, links=links)
        with running(site) as server:
            yield Desk(server, folder, receiver, tokens)


def test_links_of_an_alert_open_picture_and_recording_without_a_token(desk: Desk) -> None:
    alert = desk.alert_about(1)
    links = OpenLinks.model_validate(alert["links"])
    assert (desk.status(alert["picture"]), desk.status(f"{alert['clips']}/best")) == (401, 401)
    picture = desk.ask(links.picture or "")
    assert (picture.status_code, picture.content[:4]) == (200, b"\x89PNG")
    large = desk.ask(f"{links.picture}&size=2000")
    assert len(large.content) > len(picture.content)
    clip = desk.ask(links.clip or "")
    assert (clip.status_code, clip.content) == (200, SOUND)
    assert clip.headers["content-disposition"] == 'inline; filename="small-1-enhanced.flac"'
    part = httpx.get(links.clip or "", headers={"Range": "bytes=4-7"}, timeout=HANG_S)
    assert (part.status_code, part.content) == (206, SOUND[4:8])
    assert desk.status(links.clip or "", "HEAD") == 200
    left_s = links.until_utc.timestamp() - desk.server.parts.clock.now_ns() / 1e9
    assert 3000 < left_s <= 3600


def test_link_opens_its_path_only_and_only_for_reading(desk: Desk) -> None:
    links = desk.alert_about(2)["links"]
    signed = links["clip"].partition("?")[2]
    for other in (
        "/api/v1/events/small-2/clips/enhanced.flac",
        "/api/v1/events/small-1/clips/best",
        "/api/v1/events/small-2/clips",
        "/api/v1/events",
        "/api/v1/map",
        "/metrics",
    ):
        assert desk.status(f"{other}?{signed}") == 401, other
    for method in ("PUT", "POST", "DELETE"):
        assert desk.status(links["clip"], method) == 401, method
    clips = desk.server.parts.clips
    assert clips is not None
    assert clips.folder.read("small-2") is not None


def test_changed_link_is_refused_and_a_token_still_works_with_it(desk: Desk) -> None:
    link = desk.alert_about(3)["links"]["picture"]
    later = re.sub(r"expires=(\d+)", lambda found: f"expires={int(found[1]) + 1}", link)
    swapped = link[:-1] + ("A" if link[-1] != "A" else "B")
    for broken in (later, swapped, link[:-1], link.replace("signature=", "signature=&x="), f"{link}%00"):
        assert desk.status(broken) == 401, broken
    answer = desk.ask(later)
    assert "as the server signed it" in answer.json()["detail"]
    assert desk.status(later, role="viewer") == 200


def test_link_expires(desk: Desk) -> None:
    """A link that was signed two minutes ago, with the server's own secret, for one minute."""
    event_id = desk.alert_about(4)["event"]["id"]
    earlier = UnpacedClock(desk.server.parts.clock.now_ns() - 120_000_000_000)
    link, _ = SignedLinks(earlier, desk.folder / "links.secret").sign(f"/api/v1/events/{event_id}/clips/best", 60)
    answer = desk.ask(link)
    assert (answer.status_code, "has expired" in answer.json()["detail"]) == (401, True)
    link, _ = SignedLinks(earlier, desk.folder / "links.secret").sign(f"/api/v1/events/{event_id}/clips/best", 600)
    assert desk.status(link) == 200


def test_deleted_recording_ends_its_link(desk: Desk) -> None:
    link = desk.alert_about(5)["links"]["clip"]
    assert desk.status(link) == 200
    assert desk.status("/api/v1/events/small-5/clips", "DELETE", "operator") == 200
    assert desk.status(link) == 404


def test_roles_hold(desk: Desk) -> None:
    """Viewers cannot listen: what they may read has no link, and they can make none."""
    desk.alert_about(6)
    for path in ("alerts", "history/journal"):
        assert "signature" not in desk.ask(f"/api/v1/{path}", role="viewer").text
    wanted = {"path": "/api/v1/events/small-6/clips/best"}
    assert desk.ask("/api/v1/links", "POST", "viewer", json=wanted).status_code == 403
    assert desk.ask("/api/v1/links", "POST", json=wanted).status_code == 401
    made = desk.ask("/api/v1/links", "POST", "operator", json={**wanted, "lifetime_s": 60}).json()
    assert utc_ns(made["until_utc"]) - desk.server.parts.clock.now_ns() <= 60_000_000_000
    assert desk.ask(made["link"]).content == SOUND
    made = desk.ask("/api/v1/links", "POST", "operator", json={"path": "/api/v1/map"}).json()
    assert desk.status(f"{made['link']}&view=side") == 204  # nothing has been located yet
    assert utc_ns(made["until_utc"]) - desk.server.parts.clock.now_ns() <= 600_000_000_000, "it shows what happens now"
    for path in ("/api/v1/access", "/metrics", "https://elsewhere/api/v1/map"):
        assert desk.ask("/api/v1/links", "POST", "operator", json={"path": path}).status_code == 422


def test_another_secret_ends_all_links_at_once(desk: Desk) -> None:
    """The file is deleted; one that others can read then changes nothing, as with tokens."""
    before = desk.alert_about(7)["links"]["clip"]
    secret = desk.folder / "links.secret"
    assert secret.stat().st_mode & 0o777 == 0o600
    assert desk.status(before) == 200
    secret.unlink()
    assert desk.status(before) == 401
    after_it = desk.alert_about(8)["links"]["clip"]
    assert (desk.status(before), desk.status(after_it)) == (401, 200)
    kept = secret.read_text(encoding="utf-8")
    secret.chmod(0o644)
    assert desk.status(after_it) == 200
    secret.chmod(0o600)
    secret.write_text(kept, encoding="utf-8")
    assert desk.status(after_it) == 200


def test_server_without_tokens_signs_nothing(tmp_path: Path) -> None:
    with running_receiver() as receiver, running(linking_site(tmp_path, receiver.url)) as server:
        desk = Desk(server, tmp_path, receiver, {})
        alert = desk.alert_about(1)
        assert "links" not in alert
        assert desk.status(alert["picture"]) == 200
        assert desk.status(f"{alert['clips']}/best?expires=1&signature=x") == 200, (
            "a link from before still leads there"
        )
        refused = desk.ask("/api/v1/links", "POST", json={"path": "/api/v1/map"})
        assert (refused.status_code, "uses no tokens" in refused.json()["detail"]) == (409, True)
    assert not (tmp_path / "links.secret").exists()


def alert_about(sounded: Any, **changes: Any) -> JsonObject:
    """An alert with picture and recordings."""
    message = encoded(sounded)
    head = {"key": "alert_1", "text": "a sound", "time_utc": message["time_utc"], "link": "http://ears/#event=small-1"}
    return {**head, "picture": "http://ears/p", "clips": "http://ears/c", "event": message, **changes}


@pytest.mark.parametrize("of", [(), ("picture",), ("clip",), ("picture", "clip")])
def test_alert_has_the_links_that_the_site_file_permits(of: tuple[Any, ...]) -> None:
    links = SignedLinks(UnpacedClock(NOW_NS), None)
    alert = with_links(alert_about(sound(1)), links, LinksConfig(of=of), "https://ears.example.org")
    text = body(alert)
    if not of:
        assert alert["links"] is None
        assert "signature" not in text
        return
    assert {name for name in ("picture", "clip") if alert["links"][name] is not None} == set(of)
    assert utc_ns(alert["links"]["until_utc"]) == NOW_NS + 86_400_000_000_000
    assert text.count("https://ears.example.org/api/v1/") == len(of)
    assert text.splitlines()[-1] == "alert_1"


def test_alert_without_a_place_or_a_recording_has_no_link_to_one() -> None:
    links, both = SignedLinks(UnpacedClock(NOW_NS), None), LinksConfig(of=("picture", "clip"))
    assert with_links(alert_about(sound(1), picture=None, clips=None, event=None), links, both, "")["links"] is None
    from_a_direction = alert_about(sound(1), event={**encoded(sound(1)), "status": "direction-only"})
    assert with_links(from_a_direction, links, both, "")["links"]["clip"] is None


IDS = st.from_regex(r"[A-Za-z0-9_-]{1,20}", fullmatch=True)


class ClockThatIsSet(UnpacedClock):
    """A clock that shows what it is set to, also an earlier time."""

    shown_ns = NOW_NS

    def now_ns(self) -> int:
        return self.shown_ns


@given(IDS, IDS, st.floats(60, 1e6), st.floats(-1e5, 1e5))
def test_link_is_valid_until_it_expires_for_its_path_and_secret_only(
    one: str, other: str, lifetime_s: float, offset_s: float
) -> None:
    clock = ClockThatIsSet()
    links = SignedLinks(clock, None)
    link, expires_ns = links.sign(f"/api/v1/events/{one}/clips/best", lifetime_s)
    query = httpx.URL(link).params
    at_ns = expires_ns + round(offset_s * 1e9)
    clock.shown_ns = at_ns
    expected = Verdict.VALID if at_ns < expires_ns else Verdict.EXPIRED
    assert links.check(f"/api/v1/events/{one}/clips/best", query["expires"], query["signature"]) is expected
    if one != other:
        found = links.check(f"/api/v1/events/{other}/clips/best", query["expires"], query["signature"])
        assert found is Verdict.INVALID
    stranger = SignedLinks(UnpacedClock(NOW_NS), None)
    found = stranger.check(f"/api/v1/events/{one}/clips/best", query["expires"], query["signature"])
    assert found is Verdict.INVALID


@given(st.text(max_size=40), st.text(max_size=60))
def test_whatever_comes_as_a_signature_is_refused(expires: str, signature: str) -> None:
    links = SignedLinks(UnpacedClock(NOW_NS), None)
    assert links.check("/api/v1/map", expires, signature) is Verdict.INVALID
