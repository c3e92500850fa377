"""Reload of the site file: what takes effect, what needs a restart, and that faults change nothing."""

from __future__ import annotations

import json
import re
import signal
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from threading import Event as Flag
from typing import Any

import httpx
import numpy as np
import pytest
import yaml

from alert_desk import ELSEWHERE, PATIENT, after, alert_site, key_of, running_desk, sound
from livessl.core.stream.final_pass import FinalResults
from livessl.core.types import Event, FloatArray
from livessl.errors import ConfigError, RunError
from livessl.server.alerts import service
from livessl.server.alerts.in_force import AlertsInForce, Surroundings
from livessl.server.alerts.outbox import DeliveryState, Outbox
from livessl.server.api.encode import Messages
from livessl.server.app import Server
from livessl.server.reload import Reloader
from livessl.site.build.calibrated import typed_arrays
from livessl.site.load import load_site
from livessl.site.models import Site
from livessl.site.tokens import add_token
from livessl.site.zone_models import Zone
from notify_socket import listening
from small_site import HANG_S, SMALL, Changes, running_server, site_of, started, wait_until, write_site
from webhook_receiver import running_receiver

CENTRE = {"bounds_m": [[1.5, 2.5], [1.5, 2.5], [0.0, 2.5]]}
"""A zone in which `ELSEWHERE` lies."""

WEST = {"position_m": [0.6, 2.5, 1.5]}

DOOR = {"events": {"zones": ["door"]}, "hold_off_s": 0}
IN_CENTRE = {"events": {"zones": ["centre"]}, "hold_off_s": 0}


@contextmanager
def serving(directory: Path, changes: Changes | None = None) -> Iterator[Server]:
    """A server of a site file that can be written anew."""
    path = write_site(directory, changes)
    with running_server(load_site(path), read_site=lambda: load_site(path)) as server:
        yield server


def finish(server: Server, *events: Event) -> None:
    """Let events become final, as the fusion thread does."""
    messages = Messages(server.parts.site, 0, utc=True)
    server.parts.event_log.add_final(FinalResults(events, after(*events)), messages, {})


def alerted(server: Server) -> list[str]:
    return [alert["key"] for _, alert in server.parts.alerts.outbox.recent(1000)][::-1]


def test_zones_and_rules_take_effect_and_the_rest_says_that_it_needs_a_restart(tmp_path: Path) -> None:
    known, unknown = sound(1), sound(2, ELSEWHERE)
    with serving(tmp_path, {"alerts": {"rules": {"door": DOOR}}}) as server:
        finish(server, known, unknown)
        wait_until(lambda: alerted(server) == [key_of(known)], "the alert of the first rule")
        moved = {"zones.centre": CENTRE, "alerts": {"rules": {"door": DOOR, "centre": IN_CENTRE}}}
        further = {"fusion.min_arrays": 2, "server.http.port": 8000}
        write_site(tmp_path, {**moved, **further})
        answer = httpx.post(f"{server.url}/api/v1/reload", timeout=HANG_S)
        assert answer.status_code == 200, answer.text
        found = answer.json()
        assert sorted(found["changed"]) == ["alerts.rules.centre", "zones.centre"]
        assert sorted(found["needs_restart"]) == ["fusion.min_arrays", "server.http.port"]
        assert list(httpx.get(f"{server.url}/api/v1/zones", timeout=HANG_S).json()["zones"]) == ["door", "centre"]
        before, later = sound(3), sound(4, ELSEWHERE)
        finish(server, before, later)
        wanted = [key_of(known), key_of(before), key_of(later, "centre")]
        wait_until(lambda: sorted(alerted(server)) == sorted(wanted), "alerts of both rules")
        again = server.parts.reloader.reload()
        assert list(again.changed) == []
        assert sorted(again.needs_restart) == ["fusion.min_arrays", "server.http.port"], "as long as it is so"
        write_site(tmp_path)
        assert sorted(server.parts.reloader.reload().changed) == [
            "alerts.rules.centre",
            "alerts.rules.door",
            "zones.centre",
        ]
        assert server.parts.alerts.states == {}


def test_change_that_is_reported_as_refused_is_not_made_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread that judges is busy for longer than the reload waits."""
    site = alert_site(tmp_path, rules={"door": DOOR})
    other = site.alerts.model_copy(update={"rules": {}})
    made: list[object] = []

    class Noted(AlertsInForce):
        def __init__(self, site: Site, outbox: Outbox, around: Surroundings) -> None:
            made.append(site.alerts)
            super().__init__(site, outbox, around)

    with running_desk(site) as desk:
        busy, free = Flag(), Flag()

        def work(_: object) -> None:
            busy.set()
            free.wait(HANG_S)

        desk.on_alert = work
        desk.finish(sound(1))
        assert busy.wait(HANG_S)
        monkeypatch.setattr(service, "AlertsInForce", Noted)
        monkeypatch.setattr(service, "TAKE_OVER_S", 0.01)
        with pytest.raises(RunError, match="the former rules stay in force; reload again later"):
            desk.alerts.take_over(other)
        free.set()
        monkeypatch.setattr(service, "TAKE_OVER_S", HANG_S)
        desk.alerts.take_over(other)  # the thread comes to this change after the one that was given up
        assert made == [other]
        assert desk.alerts.config == other


BROKEN: list[Changes] = [
    {"zones.door.bounds_m": [[7.0, 8.0], [0.0, 1.0], [0.0, 2.5]]},
    {"alerts": {"rules": {"hall": {"events": {"zones": ["hall"]}}}}},
    {"server.http.host": "0.0.0.0"},
    {"alerts": {"rules": {"a": DOOR}, "actions": {"g": {"webhook": {"url": "http://127.0.0.1/", "secret": "no"}}}}},
    {"colour": "red", "zones.centre": CENTRE},
]
"""A zone outside the room, a rule about no zone, an address open to all, a secret that is not there, an unknown key."""


def test_file_with_a_fault_changes_nothing_and_is_refused_with_its_faults(tmp_path: Path) -> None:
    good = {"alerts": {"rules": {"door": DOOR}}}
    with serving(tmp_path, good) as server:
        before, rules = server.parts.zone_book.describe(), server.parts.alerts.config
        for number, changes in enumerate(BROKEN, 1):
            path = write_site(tmp_path, changes)
            answer = httpx.post(f"{server.url}/api/v1/reload", timeout=HANG_S)
            assert answer.status_code == 409
            assert server.parts.zone_book.describe() == before
            assert server.parts.alerts.config == rules
            if number in (1, 2, 5):  # the others show when the file is put to use
                with pytest.raises(ConfigError, match=f"^{re.escape(answer.json()['detail'])}$"):
                    load_site(path)
            finish(server, sound(number))
            wanted = [key_of(sound(earlier)) for earlier in range(1, number + 1)]
            wait_until(lambda wanted=wanted: alerted(server) == wanted, "alerts of the rule that stays")  # type: ignore[misc]
        metrics = httpx.get(f"{server.url}/metrics", timeout=HANG_S).text
        assert "\nlivessl_reload_successful 0.0\n" in metrics
        write_site(tmp_path, {**good, "zones.centre": CENTRE, "server.http.port": 8000})
        assert list(server.parts.reloader.reload().changed) == ["zones.centre"]
        metrics = httpx.get(f"{server.url}/metrics", timeout=HANG_S).text
        assert "\nlivessl_reload_successful 1.0\n" in metrics
        assert "\nlivessl_keys_need_restart 1.0\n" in metrics


def test_drawn_zones_are_read_again_and_a_zone_that_is_drawn_meanwhile_stays(tmp_path: Path) -> None:
    zones = tmp_path / "zones.yaml"
    with serving(tmp_path, {"zones_file": zones.name}) as server:
        book = server.parts.zone_book
        book.put("desk", Zone.model_validate(CENTRE))
        assert list(server.parts.reloader.reload().changed) == []
        zones.write_text(zones.read_text(encoding="utf-8").replace("desk", "table"), encoding="utf-8")
        assert list(server.parts.reloader.reload().changed) == ["zones_file"]
        assert [name for name, zone in book.describe().items() if zone["owner"] == "drawn"] == ["table"]


def test_what_waits_is_delivered_by_the_new_action_and_armed_rules_stay_as_they_were(tmp_path: Path) -> None:
    rules = {"door": {**DOOR, "actions": ["guard"]}, "off": {**DOOR, "actions": []}}
    known = sound(1)
    with running_receiver() as receiver:

        def alerts(url: str) -> Changes:
            actions = {"guard": {**PATIENT, "first_wait_s": 60.0, "longest_wait_s": 60.0, "webhook": {"url": url}}}
            return {"server.events_db": "events.sqlite", "alerts": {"actions": actions, "rules": rules}}

        with serving(tmp_path, alerts("http://127.0.0.1:9/")) as server:  # nobody listens there
            service = server.parts.alerts
            service.arm("off", False)
            finish(server, known)
            wait_until(lambda: service.deliverers["guard"].failed, "an attempt in vain")
            write_site(tmp_path, alerts(receiver.url))
            assert list(server.parts.reloader.reload().changed) == ["alerts.actions.guard.webhook.url"]
            [delivery] = service.outbox.deliveries([key_of(known)])[key_of(known)]
            assert delivery.state is DeliveryState.WAITING
            service.outbox.hasten("guard", 0)
            finish(server, sound(2))
            wait_until(lambda: set(receiver.keys) == {key_of(known), key_of(sound(2))}, "both alerts")
            assert not service.states["off"].armed
            assert service.states["door"].armed


def test_first_rules_of_a_site_are_kept_and_alert_about_what_comes_then(tmp_path: Path) -> None:
    with serving(tmp_path, {"server.events_db": "events.sqlite"}) as server:
        finish(server, sound(1))
        wait_until(lambda: server.parts.event_log.is_saved, "the store")
        write_site(tmp_path, {"server.events_db": "events.sqlite", "alerts": {"rules": {"door": DOOR}}})
        assert list(server.parts.reloader.reload().changed) == ["alerts.rules.door"]
        finish(server, sound(2))
        wait_until(lambda: alerted(server) == [key_of(sound(2))], "the alert, and none about the time before")
        assert server.parts.alerts.outbox.path == tmp_path / "alerts.sqlite"


def test_calibration_file_and_moved_array_take_effect(tmp_path: Path) -> None:
    before_m = site_of().array("south").microphones_m

    def measure(microphones_m: FloatArray) -> None:
        content = {"arrays": {"south": {"microphones_m": microphones_m.round(4).tolist()}}}
        (tmp_path / "measured.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")

    measure(before_m)
    with serving(tmp_path, {"calibration": "measured.yaml"}) as server:

        def microphones(array: str) -> Any:
            site = httpx.get(f"{server.url}/api/v1/site", timeout=HANG_S).json()
            return site["arrays"][array]["microphones_m"]

        moved_m = before_m + np.array([0.05, 0.0, 0.0])
        measure(moved_m)
        write_site(tmp_path, {"calibration": "measured.yaml", "arrays.north.position_m": [1.8, 1.3, 1.4]})
        result = server.parts.reloader.reload()
        assert (sorted(result.changed), list(result.needs_restart)) == (
            ["arrays.north.position_m", "arrays.south"],
            [],
        )
        assert microphones("south") == moved_m.round(4).tolist()
        assert np.mean(microphones("north"), axis=0)[0] == pytest.approx(1.8)
        write_site(tmp_path, {"calibration": "measured.yaml", "arrays.west": SMALL["arrays"]["south"] | WEST})
        result = server.parts.reloader.reload()
        assert (list(result.changed), sorted(result.needs_restart)) == ([], ["arrays.north.position_m", "arrays.west"])
        assert microphones("south") == moved_m.round(4).tolist()


def test_poses_that_were_accepted_while_rules_were_taken_over_stay_in_force(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with serving(tmp_path) as server:
        set_up, alerts = server.parts.set_up, server.parts.alerts
        moved_m = set_up.site.array("south").microphones_m + 0.1
        take_over = alerts.take_over

        def slow(config: Any) -> None:
            set_up.accept(typed_arrays(set_up.site, {"south": moved_m}), "typed")
            take_over(config)

        monkeypatch.setattr(alerts, "take_over", slow)
        write_site(tmp_path, {"alerts": {"rules": {"door": DOOR}}, "arrays.north.position_m": [1.8, 1.3, 1.4]})
        assert "arrays.north.position_m" in server.parts.reloader.reload().changed
        assert set_up.site.array("south").microphones_m == pytest.approx(moved_m, abs=1e-4)
        assert set_up.site.array("north").centre_m[0] == pytest.approx(1.8)


class Still:
    """Poses that can or cannot be taken over."""

    def __init__(self, site: Site, fault: str | None = None) -> None:
        self.site = site
        self.fault = fault

    def unchanged(self) -> AbstractContextManager[None]:
        return nullcontext()

    def calibrated(self, site: Site) -> Site:
        return site

    def take_over(self, site: Site) -> list[str]:
        if self.fault is not None:
            raise RunError(self.fault)
        self.site = site
        return ["north"]


@pytest.mark.parametrize("fault", [None, "array 'north': expected 4 microphones, got 5; restart the server"])
def test_poses_are_taken_over_or_need_a_restart(tmp_path: Path, fault: str | None) -> None:
    path = write_site(tmp_path)
    with running_server(load_site(path)) as server:
        parts, poses = server.parts, Still(parts_site := server.parts.site, fault)
        reloader = Reloader(parts_site, lambda: load_site(path), parts.zone_book, parts.alerts, None, poses)
        write_site(tmp_path, {"arrays.north.position_m": [1.8, 1.3, 1.4], "arrays.north.band_hz": [200, 4000]})
        result = reloader.reload()
        pose, band = ["arrays.north.position_m"], ["arrays.north.band_hz"]
        assert (result.changed, sorted(result.needs_restart)) == (
            (pose, band) if fault is None else ([], [*band, *pose])
        )
        again = reloader.reload()
        assert (list(again.changed), sorted(again.needs_restart)) == ([], band if fault is None else [*band, *pose])


def test_only_operators_may_reload_and_a_server_without_a_file_says_so(tmp_path: Path) -> None:
    path = write_site(tmp_path, {"server.http.tokens": "tokens.yaml"})
    tokens = {role: add_token(tmp_path / "tokens.yaml", role, role) for role in ("viewer", "operator")}
    with running_server(load_site(path)) as server:

        def post(role: str) -> httpx.Response:
            headers = {"Authorization": f"Bearer {tokens[role]}"}
            return httpx.post(f"{server.url}/api/v1/reload", headers=headers, timeout=HANG_S)

        assert post("viewer").status_code == 403
        answer = post("operator")
        assert (answer.status_code, answer.json()["detail"]) == (
            409,
            "this server was not started from a site file; restart it to change its settings",
        )


@pytest.mark.processes
def test_hang_up_signal_reloads_and_a_broken_file_is_reported_while_the_server_runs_on(tmp_path: Path) -> None:
    path = write_site(tmp_path)
    log = tmp_path / "log"
    words = (sys.executable, "-m", "livessl", "--log", "json", "serve", "--site", path)
    with (
        listening(tmp_path, reads=True) as manager,
        log.open("w") as stderr,
        started(*words, stderr=stderr, env=manager.environment(silence_s=4.0)) as process,
    ):

        def lines() -> list[dict[str, Any]]:
            return [json.loads(line) for line in log.read_text().splitlines(keepends=True) if line.endswith("\n")]

        def logged(text: str, level: str = "info") -> None:
            def is_there() -> bool:
                return any((line["message"], line["level"]) == (text, level) for line in lines())

            wait_until(lambda: is_there() or process.poll() is not None, text)
            assert process.poll() is None, log.read_text()

        wait_until(lambda: manager.count("READY=1") or process.poll() is not None, "the server")
        found = re.search(r"dashboard on (http://[\d.:]+)", log.read_text())
        assert found is not None
        assert httpx.get(f"{found[1]}/api/v1/health").status_code == 200, "it is ready"
        write_site(tmp_path, {"zones.centre": CENTRE, "fusion.min_arrays": 2})
        process.send_signal(signal.SIGHUP)
        logged("the site file was read again: zones.centre took effect; fusion.min_arrays needs a restart")
        path.write_text("site: small\nroom: {size_m: [4, 5]}\n", encoding="utf-8")
        with pytest.raises(ConfigError) as caught:
            load_site(path)
        process.send_signal(signal.SIGHUP)
        logged(f"the site file was not taken over, and the former settings stay in force: {caught.value}", "error")
        write_site(tmp_path)
        process.send_signal(signal.SIGHUP)
        logged("the site file was read again: zones.centre took effect")
        wait_until(lambda: manager.count("READY=1") == 4, "the end of the reload")
        wait_until(lambda: manager.count("WATCHDOG=1") > 1, "a sign of life")
        process.terminate()
        assert process.wait(HANG_S) == 0
        states = [line for line in manager.said if line in ("READY=1", "RELOADING=1", "STOPPING=1")]
        assert states == ["READY=1", *["RELOADING=1", "READY=1"] * 3, "STOPPING=1"]
        assert {line["command"] for line in lines()} == {"serve"}
