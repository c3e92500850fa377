"""Webhooks to a real receiver: signatures, failures, retries, dead letters."""

from __future__ import annotations

import json
import shutil
import socket
import ssl
import subprocess
from collections.abc import Iterator
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from alert_desk import PATIENT, Desk, alert_site, encoded, key_of, running_desk, sound
from conftest import require
from livessl.clock import SystemClock
from livessl.errors import ConfigError
from livessl.lab.processes import free_port
from livessl.server.alerts.delivery import backoff_s
from livessl.server.alerts.outbox import DeliveryState, OutboxError
from livessl.site.alert_models import AlertAction
from livessl.site.models import Site
from small_site import HANG_S, wait_until
from webhook_receiver import Receiver, running_receiver

SECRET = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"
RULE = {"events": {"zones": ["door"]}, "hold_off_s": 0, "actions": ["guard"]}


def secret_file(directory: Path, text: str = SECRET) -> str:
    path = directory / "hook.secret"
    path.write_text(text + "\n", encoding="utf-8")
    path.chmod(0o600)
    return path.name


def hook_site(directory: Path, url: str, *, kept: bool = False, **action: Any) -> Site:
    changes = {"server.events_db": "events.sqlite"} if kept else {}
    hook = {"url": url, **action.pop("webhook", {})}
    settings = {**PATIENT, **action, "webhook": hook}
    return alert_site(directory, changes, actions={"guard": settings}, rules={"door": RULE})


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with running_receiver() as receiver:
        yield receiver


def states(desk: Desk) -> dict[str, int]:
    return {state: count for (_, state), count in desk.alerts.outbox.counts().items()}


def test_an_alert_that_has_arrived_is_not_sent_again_while_the_outbox_cannot_be_written(
    tmp_path: Path, receiver: Receiver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("livessl.server.alerts.delivery.REST_S", 0.01)
    with running_desk(hook_site(tmp_path, receiver.url)) as desk:
        refused: list[int] = []
        note = desk.alerts.outbox.delivered

        def full(number: int) -> None:
            refused.append(number)
            if len(refused) < 5:
                raise OutboxError("the disk is full")
            note(number)

        monkeypatch.setattr(desk.alerts.outbox, "delivered", full)
        desk.finish(sound(1))
        wait_until(lambda: states(desk) == {"delivered": 1}, "the delivery")
    assert len(refused) == 5
    assert len(receiver.requests) == 1


def test_an_error_that_nobody_expected_is_a_failed_attempt(tmp_path: Path) -> None:
    """A host with an empty label is no host that can be looked up; the library's error is no error of the network."""
    with running_desk(hook_site(tmp_path, "http://hooks..example.org/", attempts=1)) as desk:
        desk.finish(sound(1))
        wait_until(lambda: states(desk) == {"dead": 1}, "the dead letter")
        [[delivery]] = desk.alerts.outbox.deliveries([key_of(sound(1))]).values()
    assert "UnicodeError" in str(delivery.error)


def test_alert_arrives_signed_and_says_what_when_where_and_how_sure(tmp_path: Path, receiver: Receiver) -> None:
    clock = SystemClock()
    with running_desk(hook_site(tmp_path, receiver.url, webhook={"secret": secret_file(tmp_path)})) as desk:
        before_s = clock.now_ns() // 10**9
        desk.finish(sound(1))
        wait_until(lambda: states(desk).get("delivered"), "the delivery")
    [request] = receiver.requests
    assert request.path == "/hook"
    assert request.headers["content-type"] == "application/json"
    assert request.is_signed_by(SECRET)
    assert not request.is_signed_by("whsec_" + "A" * 32)
    assert before_s <= int(request.headers["webhook-timestamp"]) <= clock.now_ns() // 10**9
    payload = json.loads(request.body)
    assert (payload["type"], payload["timestamp"]) == ("livessl.alert", encoded(sound(1))["time_utc"])
    assert payload["data"] == desk.published[0]
    assert request.key == payload["data"]["key"] == key_of(sound(1))
    assert payload["data"]["event"]["position_m"] == [0.5, 0.5, 1.0]


def test_without_a_secret_nothing_is_signed(tmp_path: Path, receiver: Receiver) -> None:
    with running_desk(hook_site(tmp_path, receiver.url)) as desk:
        desk.finish(sound(1))
        wait_until(lambda: receiver.accepted, "the delivery")
    assert "webhook-signature" not in receiver.requests[0].headers


def test_receiver_that_fails_and_comes_back_gets_every_alert_under_its_key(tmp_path: Path, receiver: Receiver) -> None:
    receiver.answer = lambda: (503, {})
    events = [sound(number) for number in range(4)]
    with running_desk(hook_site(tmp_path, receiver.url)) as desk:
        desk.finish(*events)
        wait_until(lambda: len(receiver.requests) >= 6, "some attempts")
        assert states(desk) == {"waiting": 4}
        receiver.answer = lambda: (200, {})
        wait_until(lambda: states(desk) == {"delivered": 4}, "all deliveries")
    assert sorted(receiver.keys) == sorted(key_of(event) for event in events)
    bodies = {request.key: set() for request in receiver.requests}  # type: dict[str, set[bytes]]
    for request in receiver.requests:
        bodies[request.key].add(request.body)
    assert {len(found) for found in bodies.values()} == {1}


def test_address_without_a_receiver_gets_the_alert_once_there_is_one(tmp_path: Path) -> None:
    port = free_port()
    with running_desk(hook_site(tmp_path, f"http://127.0.0.1:{port}/hook")) as desk:
        desk.finish(sound(1))
        wait_until(lambda: desk.alerts.deliverers["guard"].failed >= 2, "failed attempts")
        [delivery] = desk.alerts.outbox.deliveries([key_of(sound(1))])[key_of(sound(1))]
        assert delivery.error is not None
        assert delivery.error.startswith(f"cannot reach 127.0.0.1:{port}: ")
        with running_receiver(port) as receiver:
            wait_until(lambda: receiver.keys == [key_of(sound(1))], "the delivery")


def test_alert_that_waits_is_delivered_after_a_restart(tmp_path: Path, receiver: Receiver) -> None:
    receiver.answer = lambda: (500, {})
    with running_desk(hook_site(tmp_path, receiver.url, kept=True)) as desk:
        desk.finish(sound(1))
        wait_until(lambda: receiver.requests, "an attempt")
    receiver.answer = lambda: (204, {})
    with running_desk(hook_site(tmp_path, receiver.url, kept=True)) as desk:
        wait_until(lambda: states(desk) == {"delivered": 1}, "the delivery")
    assert receiver.keys == [key_of(sound(1))]


@pytest.mark.parametrize(("status", "attempts"), [(500, 3), (404, 3), (302, 3), (410, 1)])
def test_dead_letter_after_the_last_attempt_can_be_sent_again(
    tmp_path: Path, receiver: Receiver, status: int, attempts: int
) -> None:
    """Redirections are not followed, and 410 says that further attempts are pointless."""
    receiver.answer = lambda: (status, {"Location": f"{receiver.url}/else"})
    with running_desk(hook_site(tmp_path, receiver.url, attempts=3)) as desk:
        desk.finish(sound(1))
        wait_until(lambda: states(desk) == {"dead": 1}, "the end of all attempts")
        assert len(receiver.requests) == attempts
        assert desk.alerts.problems == ["alerts.actions.guard: 1 alert was given up; see GET alerts/dead-letters"]
        [(dead, alert)] = desk.alerts.outbox.dead(10)
        assert (dead.state, dead.error) == (DeliveryState.DEAD, f"answered {status}, expected 2xx")
        assert alert["key"] == key_of(sound(1))
        receiver.answer = lambda: (204, {})
        desk.alerts.dead_letters.resend(dead.number)
        wait_until(lambda: states(desk) == {"delivered": 1}, "the delivery")
        assert desk.alerts.problems == []


def test_wait_that_the_receiver_asks_for_is_kept(tmp_path: Path, receiver: Receiver) -> None:
    receiver.answer = lambda: (429, {"Retry-After": "30"})
    clock = SystemClock()
    with running_desk(hook_site(tmp_path, receiver.url, longest_wait_s=60)) as desk:
        desk.finish(sound(1))
        wait_until(lambda: desk.alerts.deliverers["guard"].failed, "an attempt")
        wait_until(lambda: (desk.alerts.outbox.next_due_ns("guard") or 0) > clock.now_ns(), "the next time")
        assert (desk.alerts.outbox.next_due_ns("guard") or 0) > clock.now_ns() + 20 * 10**9
        assert len(receiver.requests) == 1


@pytest.mark.parametrize("answer", [b"", b"SSH-2.0-OpenSSH\r\n\r\n", b"HTTP/1.1 9\r\n\r\n", b"x" * 40_000, None])
def test_anything_but_an_answer_of_http_is_a_failed_attempt(tmp_path: Path, answer: bytes | None) -> None:
    """None stands for a receiver that never answers."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"http://127.0.0.1:{listener.getsockname()[1]}/"
        held: list[socket.socket] = []

        def serve() -> None:
            connection, _ = listener.accept()
            held.append(connection)
            connection.recv(65536)
            if answer is not None:
                connection.sendall(answer)
                connection.shutdown(socket.SHUT_WR)

        serving = Thread(target=serve)
        serving.start()
        with running_desk(hook_site(tmp_path, url, attempts=1, timeout_s=0.5 if answer is None else 20)) as desk:
            desk.finish(sound(1))
            wait_until(lambda: states(desk) == {"dead": 1}, "the failed attempt")
            [(dead, _)] = desk.alerts.outbox.dead(1)
        serving.join(timeout=HANG_S)
        held[0].close()
    assert dead.error is not None
    expected = "no answer within 0.5 s" if answer is None else "expected an HTTP answer|cannot reach"
    assert any(dead.error.startswith(part) for part in expected.split("|"))


def test_interim_answer_is_not_the_answer(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.recv(65536)
                connection.sendall(b"HTTP/1.1 103 Early Hints\r\n\r\nHTTP/1.1 204 No Content\r\n\r\n")

        serving = Thread(target=serve)
        serving.start()
        with running_desk(hook_site(tmp_path, f"http://127.0.0.1:{listener.getsockname()[1]}/")) as desk:
            desk.finish(sound(1))
            wait_until(lambda: states(desk) == {"delivered": 1}, "the delivery")
        serving.join(timeout=HANG_S)


def test_https_needs_a_certificate_that_is_trusted(tmp_path: Path) -> None:
    require(shutil.which("openssl") is not None, "openssl is not installed (Debian: apt install openssl)")
    new = ["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=127.0.0.1", "-keyout", "a.key"]
    new += ["-out", "a.crt", "-addext", "subjectAltName=IP:127.0.0.1"]
    subprocess.run(["openssl", *new], cwd=tmp_path, check=True, capture_output=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(tmp_path / "a.crt", tmp_path / "a.key")
    with running_receiver(tls=context) as receiver:
        with running_desk(hook_site(tmp_path, receiver.url, attempts=1)) as desk:
            desk.finish(sound(1))
            wait_until(lambda: states(desk) == {"dead": 1}, "the refusal")
            [(dead, _)] = desk.alerts.outbox.dead(1)
            assert dead.error is not None
            assert "certificate" in dead.error.lower()
        with running_desk(hook_site(tmp_path, receiver.url, webhook={"ca": "a.crt"})) as desk:
            desk.finish(sound(1))
            wait_until(lambda: states(desk) == {"delivered": 1}, "the delivery")


@pytest.mark.parametrize("text", ["secret", "whsec_", "whsec_AAAA", "whsec_" + "A" * 30 + "!!", "whsec_" + "A" * 96])
def test_text_that_is_no_secret_is_refused_without_repeating_it(tmp_path: Path, text: str) -> None:
    site = hook_site(tmp_path, "http://127.0.0.1:1/", webhook={"secret": secret_file(tmp_path, text)})
    with pytest.raises(ConfigError, match=r"hook\.secret: expected whsec_ and 24 to 64 bytes") as caught:
        Desk(site)
    assert "AAAA" not in str(caught.value)


def test_secret_that_others_can_read_is_refused(tmp_path: Path) -> None:
    site = hook_site(tmp_path, "http://127.0.0.1:1/", webhook={"secret": secret_file(tmp_path)})
    (tmp_path / "hook.secret").chmod(0o644)
    with pytest.raises(ConfigError, match="only its owner can use, got mode 644; chmod 600 it"):
        Desk(site)


def test_waits_double_up_to_the_longest() -> None:
    config = AlertAction.model_validate({"command": ["true"], "first_wait_s": 2, "longest_wait_s": 10})
    waits = [backoff_s(config, attempts, "alert_1") for attempts in range(1, 9)]
    for wait_s, least_s in zip(waits, (2, 4, 8, 10, 10, 10, 10, 10), strict=True):
        assert least_s <= wait_s <= 1.1 * least_s
    assert backoff_s(config, 1000, "alert_1") <= 11
    assert len({backoff_s(config, 1, f"alert_{number}") for number in range(20)}) > 10
