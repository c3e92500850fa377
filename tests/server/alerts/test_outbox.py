"""The outbox: what it keeps, and what it never keeps twice."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from pathlib import Path

import pytest

from alert_desk import alert_site, dated, sound
from livessl.server.alerts import outbox as outbox_module
from livessl.server.alerts.message import AlertMessages
from livessl.server.alerts.outbox import DeliveryState, Outbox, OutboxError, Raised
from livessl.server.alerts.rules import Match, RuleState

HOUR_NS = 3600 * 10**9
MESSAGES = AlertMessages(alert_site(), "http://127.0.0.1:8000")


def raised(number: int = 0, actions: Sequence[str] = ("guard",), rule: str = "door") -> Raised:
    [(event, time_ns)] = dated(sound(number))
    return Raised(MESSAGES.of_event(rule, event, Match({"door": 0.9}), 1, time_ns), time_ns, actions)


def test_everything_survives_a_restart(tmp_path: Path) -> None:
    first = Outbox(tmp_path / "alerts.sqlite")
    state = RuleState(armed=False, alerted_ns=(3,))
    first.commit([raised()], {"door": state}, 10, ("small", 99))
    first.close()
    again = Outbox(tmp_path / "alerts.sqlite")
    assert again.states() == {"door": state}
    assert again.judged_until_ns("small") == 99
    due = again.due("guard", 10, HOUR_NS)
    assert due is not None
    assert due.alert == raised().alert
    again.close()


def test_an_alert_with_the_same_key_is_kept_once_and_delivered_once() -> None:
    outbox = Outbox()
    assert outbox.commit([raised()], {}, 10) == [raised().alert]
    assert outbox.commit([raised(), raised(1)], {}, 10) == [raised(1).alert]
    assert len(outbox.recent(10)) == 2
    assert outbox.counts() == {("guard", "waiting"): 2}
    assert raised().alert["key"] != raised(rule="window").alert["key"]


def test_an_action_that_is_named_twice_is_done_once() -> None:
    outbox = Outbox()
    outbox.commit([raised(actions=("guard", "guard"))], {}, 10)
    assert outbox.counts() == {("guard", "waiting"): 1}


def test_nothing_is_kept_of_a_batch_that_fails() -> None:
    outbox = Outbox()
    broken = raised(1)
    del broken.alert["key"]
    with pytest.raises(KeyError):
        outbox.commit([raised(), broken], {"door": RuleState(alerts=1)}, 10, ("small", 99))
    assert outbox.recent(10) == []
    assert outbox.states() == {}
    assert outbox.judged_until_ns("small") is None


def test_failed_delivery_is_due_at_its_next_time_and_dead_without_one() -> None:
    outbox = Outbox()
    outbox.commit([raised()], {}, 10)
    due = outbox.due("guard", 10, HOUR_NS)
    assert due is not None
    outbox.failed(due.number, "answered 503", 50)
    assert outbox.due("guard", 49, HOUR_NS) is None
    assert outbox.next_due_ns("guard") == 50
    assert outbox.due("guard", 50, HOUR_NS) == (due.number, 1, due.alert)
    outbox.failed(due.number, "answered 500", None)
    assert outbox.due("guard", 10**18, HOUR_NS) is None
    [(delivery, alert)] = outbox.dead(10)
    assert (delivery.state, delivery.attempts, delivery.error) == (DeliveryState.DEAD, 2, "answered 500")
    assert alert == due.alert


def test_only_a_dead_letter_can_be_sent_again() -> None:
    outbox = Outbox()
    outbox.commit([raised()], {}, 10)
    due = outbox.due("guard", 10, HOUR_NS)
    assert due is not None
    assert not outbox.resend(due.number, 20)
    outbox.failed(due.number, "gone", None)
    assert outbox.resend(due.number, 20)
    assert outbox.due("guard", 20, HOUR_NS) == (due.number, 0, due.alert)
    outbox.delivered(due.number)
    assert not outbox.resend(due.number, 20)
    assert not outbox.resend(99, 20)


def test_what_waits_for_an_action_that_is_gone_is_a_dead_letter_until_it_is_dismissed() -> None:
    outbox = Outbox()
    outbox.commit([raised(number, ("guard", "mail")) for number in range(2)], {}, 10)
    due = outbox.due("mail", 10, HOUR_NS)
    assert due is not None
    outbox.delivered(due.number)
    assert outbox.abandon(["guard"]) == 1
    assert outbox.counts() == {("guard", "waiting"): 2, ("mail", "dead"): 1, ("mail", "delivered"): 1}
    [(letter, _)] = outbox.dead(10)
    assert letter.error == outbox_module.NO_ACTION
    assert outbox.dismiss(letter.number) == 1
    assert outbox.dismiss(letter.number) == 0
    assert outbox.dead(10) == []
    assert outbox.action_of_dead(letter.number) is None


def test_dead_letters_are_dismissed_by_action_or_all_at_once() -> None:
    outbox = Outbox()
    outbox.commit([raised(number, ("guard", "mail", "home")) for number in range(3)], {}, 10)
    assert outbox.abandon([]) == 9
    assert outbox.dismiss(action="mail") == 3
    assert {letter.action for letter, _ in outbox.dead(10)} == {"guard", "home"}
    assert outbox.dismiss() == 6


def test_a_wait_beyond_all_waits_means_that_the_clock_was_set_back() -> None:
    outbox = Outbox()
    outbox.commit([raised()], {}, 100 * HOUR_NS)
    assert outbox.due("guard", 99 * HOUR_NS, HOUR_NS) is None
    assert outbox.due("guard", 10 * HOUR_NS, HOUR_NS) is not None


def test_alerts_beyond_the_queue_of_an_action_are_dead_letters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox_module, "MAX_WAITING", 2)
    outbox = Outbox()
    outbox.commit([raised(number, ("guard", "mail") if number else ("guard",)) for number in range(3)], {}, 10)
    assert outbox.counts() == {("guard", "waiting"): 2, ("guard", "dead"): 1, ("mail", "waiting"): 2}
    [(delivery, _)] = outbox.dead(10)
    assert delivery.error == "2 alerts were waiting for this action already"


def test_oldest_alerts_are_deleted_with_their_deliveries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox_module, "MAX_ALERTS", 2)
    outbox = Outbox()
    outbox.commit([raised(number) for number in range(5)], {}, 10)
    assert [alert for _, alert in outbox.recent(10)] == [raised(4).alert, raised(3).alert]
    assert outbox.counts() == {("guard", "waiting"): 2}


def test_expired_alerts_leave_the_file(tmp_path: Path) -> None:
    path = tmp_path / "alerts.sqlite"
    outbox = Outbox(path)
    outbox.commit([raised(0), raised(100)], {}, 10)
    assert outbox.expire(raised(50).time_ns) == 1
    assert [alert for _, alert in outbox.recent(10)] == [raised(100).alert]
    files = b"".join(each.read_bytes() for each in tmp_path.iterdir())
    assert raised(0).alert["key"].encode() not in files
    assert raised(100).alert["key"].encode() in files
    outbox.close()


def test_pages_go_on_before_a_number() -> None:
    outbox = Outbox()
    outbox.commit([raised(number, rule="door" if number % 2 else "hall") for number in range(6)], {}, 10)
    [first, second] = outbox.recent(2)
    assert [alert["event"]["id"] for _, alert in (first, second)] == ["small-5", "small-4"]
    assert [alert["event"]["id"] for _, alert in outbox.recent(2, second[0])] == ["small-3", "small-2"]
    assert [alert["event"]["id"] for _, alert in outbox.recent(9, None, "hall")] == ["small-4", "small-2", "small-0"]


def test_file_that_cannot_be_used_is_an_error_with_its_key(tmp_path: Path) -> None:
    with pytest.raises(OutboxError, match=r"alerts\.outbox: cannot use .*missing"):
        Outbox(tmp_path / "missing" / "alerts.sqlite")


def test_locked_file_is_an_error_with_its_cure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox_module, "BUSY_S", 0.01)
    outbox = Outbox(tmp_path / "alerts.sqlite")
    other = sqlite3.connect(tmp_path / "alerts.sqlite")
    other.execute("BEGIN EXCLUSIVE")
    with pytest.raises(OutboxError, match=r"alerts\.outbox: cannot be written: .*locked; free space"):
        outbox.commit([raised()], {}, 10)
    other.rollback()
    other.close()
    assert outbox.commit([raised()], {}, 10) == [raised().alert]
    outbox.close()
