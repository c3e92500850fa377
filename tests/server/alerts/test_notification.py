"""Notifications by Apprise: to a chat service's address, and as a mail to a real SMTP socket."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from email import message_from_string
from email.policy import default
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from alert_desk import PATIENT, Desk, alert_site, running_desk, sound
from livessl.errors import ConfigError
from livessl.site.alert_models import AppriseConfig
from livessl.site.models import Site
from small_site import HANG_S, wait_until
from webhook_receiver import running_receiver

pytestmark = pytest.mark.filterwarnings("ignore:'imghdr' is deprecated")  # Apprise imports it

RULE = {"events": {"zones": ["door"]}, "hold_off_s": 0, "actions": ["tell"]}


def notify_site(directory: Path, url: str, **action: Any) -> Site:
    path = directory / "notify.url"
    path.write_text(url + "\n", encoding="utf-8")
    path.chmod(0o600)
    settings = {**PATIENT, **action, "apprise": {"url": path.name}}
    return alert_site(directory, actions={"tell": settings}, rules={"door": RULE})


def states(desk: Desk) -> dict[str, int]:
    return {state: count for (_, state), count in desk.alerts.outbox.counts().items()}


@contextmanager
def mailbox() -> Iterator[tuple[int, list[str]]]:
    """A socket that speaks as much SMTP as a sender needs; yields its port and the mails."""
    mails: list[str] = []
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(HANG_S)

        def serve() -> None:
            connection, _ = listener.accept()
            with connection, connection.makefile("rw", newline="\r\n", encoding="utf-8") as lines:

                def say(text: str) -> None:
                    lines.write(f"{text}\r\n")
                    lines.flush()

                say("220 test")
                for line in lines:
                    if line.upper().startswith("DATA"):
                        say("354 go on")
                        mails.append("".join(iter(lines.readline, ".\r\n")))
                    elif line.upper().startswith("QUIT"):
                        say("221 bye")
                        return
                    say("250 ok")

        serving = Thread(target=serve, daemon=True)
        serving.start()
        yield listener.getsockname()[1], mails
        serving.join(timeout=HANG_S)


def test_mail_says_what_when_and_where_with_a_link(tmp_path: Path) -> None:
    with mailbox() as (port, mails):
        url = f"mailto://127.0.0.1:{port}?from=ears@example.org&to=guard@example.org&mode=insecure&format=text"
        with running_desk(notify_site(tmp_path, url, timeout_s=60)) as desk:
            desk.finish(sound(1))
            wait_until(lambda: states(desk) == {"delivered": 1}, "the delivery")
    [text] = mails
    mail = message_from_string(text, policy=default)
    assert mail["Subject"] == "livessl small: door"
    assert "guard@example.org" in mail["To"]
    part = mail.get_body(("plain",))
    assert part is not None
    alert = desk.published[0]
    wanted = "\n".join(alert[name] for name in ("text", "time_utc", "link", "key"))
    assert part.get_content().split() == wanted.split()


class OneClip:
    """A clip of every event, cut a little after the alert."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.looks = 0

    def is_waiting(self, event_id: str) -> bool:
        return True

    def best_file(self, event_id: str) -> Path | None:
        self.looks += 1
        return self._path if self.looks > 2 else None


@pytest.mark.parametrize("attach", [["picture", "clip"], ["picture"], []])
def test_mail_has_the_picture_and_the_clip_that_are_wanted(tmp_path: Path, attach: list[str]) -> None:
    clip = tmp_path / "enhanced.flac"
    clip.write_bytes(b"fLaC" + bytes(range(256)))
    with mailbox() as (port, mails):
        url = f"mailto://127.0.0.1:{port}?from=ears@example.org&to=guard@example.org&mode=insecure&format=text"
        site = notify_site(tmp_path, url, timeout_s=60)
        site.alerts.actions["tell"] = site.alerts.actions["tell"].model_copy(
            update={"apprise": AppriseConfig(url="notify.url", attach=tuple(attach))}
        )
        desk = Desk(site, clips=OneClip(clip))
        desk.alerts.start()
        desk.finish(sound(1))
        wait_until(lambda: states(desk) == {"delivered": 1}, "the delivery")
        picture = desk.alerts.evidence.picture(desk.published[0])
        desk.close()
    mail = message_from_string(mails[0], policy=default)
    found = {part.get_content_type(): part.get_content() for part in mail.iter_attachments()}
    kinds = {"picture": "image/png", "clip": "audio/"}
    assert len(found) == len(attach)
    for wanted in attach:
        [content] = [content for kind, content in found.items() if kind.startswith(kinds[wanted])]
        assert content == (picture if wanted == "picture" else clip.read_bytes())


def test_attempt_after_a_failed_one_is_without_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with running_receiver() as receiver:
        site = notify_site(tmp_path, receiver.url.replace("http://", "json://"), timeout_s=60)
        with running_desk(site) as desk:
            answers = iter([500, 200])
            receiver.answer = lambda: (next(answers), {})
            desk.finish(sound(1))
            wait_until(lambda: states(desk) == {"delivered": 1}, "the delivery")
    assert [b"map.png" in request.body for request in receiver.requests] == [True, False]
    assert json.loads(receiver.accepted[0].body)["message"].endswith(desk.published[0]["key"])


def test_service_that_refuses_is_tried_again(tmp_path: Path) -> None:
    with running_receiver() as receiver:
        receiver.answer = lambda: (500, {})
        url = receiver.url.replace("http://", "json://")
        with running_desk(notify_site(tmp_path, url, timeout_s=60)) as desk:
            desk.finish(sound(1))
            wait_until(lambda: desk.alerts.deliverers["tell"].failed >= 2, "failed attempts")
            receiver.answer = lambda: (200, {})
            wait_until(lambda: states(desk) == {"delivered": 1}, "the delivery")
    assert json.loads(receiver.accepted[0].body)["title"] == "livessl small: door"


@pytest.mark.parametrize("url", ["", "nothing://secret", "json://localhost json://localhost"])
def test_file_without_one_known_url_is_refused_without_repeating_it(tmp_path: Path, url: str) -> None:
    with pytest.raises(ConfigError, match=r"notify\.url: expected one URL of a service that Apprise knows") as caught:
        Desk(notify_site(tmp_path, url))
    assert "secret" not in str(caught.value)
