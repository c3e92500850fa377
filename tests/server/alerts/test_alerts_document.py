"""The examples of docs/alerts.md work as they stand."""

from __future__ import annotations

import base64
import hmac
import re
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import httpx
import yaml

from alert_desk import PATIENT, alert_site, running_desk, sound
from livessl.lab.processes import free_port
from livessl.server.alerts.actions import ACTIONS
from livessl.site.alert_models import ActionKinds, AlertAction
from small_site import started, wait_until

PAGE = (Path(__file__).parents[3] / "docs" / "alerts.md").read_text(encoding="utf-8")
RULE = {"events": {"zones": ["door"]}, "hold_off_s": 0, "actions": ["guard"]}


def block(language: str) -> str:
    [found] = re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    return str(found)


def test_example_of_a_site_file_is_valid_and_uses_every_action() -> None:
    alerts: dict[str, Any] = yaml.safe_load(block("yaml"))["alerts"]
    site = alert_site(None, {"server.events_db": "events.sqlite"}, **alerts)
    assert site.warnings == ()
    kinds = {action.kind for action in site.alerts.actions.values()}
    assert kinds == set(ACTIONS) == set(ActionKinds.model_fields)
    assert {rule.kind for rule in site.alerts.rules.values()} == {"events", "arrays", "findings"}


def test_documented_receiver_checks_the_secret_that_the_documented_command_makes(tmp_path: Path) -> None:
    port = free_port()
    subprocess.run(["sh", "-c", block("sh")], cwd=tmp_path, check=True, timeout=60)
    assert (tmp_path / "hook.secret").stat().st_mode & 0o777 == 0o600
    receiver = block("python").replace("9000", str(port))
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
    hook = {"url": f"http://127.0.0.1:{port}/", "secret": "hook.secret"}
    actions = {"guard": {**PATIENT, "webhook": hook}}
    with (
        started(sys.executable, "-c", receiver, **pipes) as process,
        running_desk(alert_site(tmp_path, actions=actions, rules={"door": RULE})) as desk,
    ):
        desk.finish(sound(1))
        wait_until(lambda: desk.alerts.counts() == {("guard", "delivered"): 1}, "the delivery")
        assert process.stdout is not None
        assert process.stdout.readline().strip() == desk.published[0]["text"]
        (tmp_path / "hook.secret").write_text("whsec_" + "A" * 40 + "\n", encoding="utf-8")
        with running_desk(alert_site(tmp_path, actions=actions, rules={"door": RULE})) as stranger:
            stranger.finish(sound(2))
            wait_until(lambda: stranger.alerts.deliverers["guard"].failed, "the refusal")
            [(_, alert)] = stranger.alerts.outbox.recent(1)
            [delivery] = stranger.alerts.outbox.deliveries([alert["key"]])[alert["key"]]
    assert delivery.error == "answered 401, expected 2xx"


def test_default_patience_lasts_as_long_as_documented() -> None:
    config = AlertAction.model_validate({"command": ["true"]})
    waits_s = [min(config.first_wait_s * 2**n, config.longest_wait_s) for n in range(config.attempts - 1)]
    assert "over about four hours" in PAGE
    assert 4.0 <= sum(waits_s) / 3600 < 4.6


def test_documented_receiver_refuses_what_is_stale_or_forged(tmp_path: Path) -> None:
    """What it does not accept it must not confirm: the alert would be lost."""
    port = free_port()
    secret = b"0123456789abcdef0123456789abcdef"
    (tmp_path / "hook.secret").write_text(f"whsec_{base64.b64encode(secret).decode()}\n", encoding="utf-8")
    receiver = block("python").replace("9000", str(port))
    body = b'{"data": {"text": "a sound"}}'

    def status(age_s: int, key: bytes = secret) -> int:
        when = str(int(time.time()) - age_s)
        digest = hmac.digest(key, f"alert_1.{when}.".encode() + body, "sha256")
        signature = "v1," + base64.b64encode(digest).decode()
        headers = {"webhook-id": "alert_1", "webhook-timestamp": when, "webhook-signature": signature}
        return httpx.post(f"http://127.0.0.1:{port}/", content=body, headers=headers, timeout=60).status_code

    def answers() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
    with started(sys.executable, "-c", receiver, **pipes) as process:
        wait_until(answers, "the receiver")
        assert [status(600), status(0, b"wrong"), status(0), status(0)] == [401, 401, 204, 204]
        process.terminate()
        assert process.stdout is not None
        assert process.stdout.read() == "a sound\n"
