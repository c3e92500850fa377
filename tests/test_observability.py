"""The files for Prometheus and Grafana: each query runs in a real Prometheus that asks a real server."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from alert_desk import PATIENT, alert_site
from conftest import require
from prometheus import MISSING, PROMTOOL, Prometheus, running_prometheus
from scene_server import capture_scene
from small_site import running_server, wait_until

DEPLOY = Path(__file__).parents[1] / "deploy"
RULES = DEPLOY / "prometheus" / "livessl.rules.yml"
DASHBOARD = DEPLOY / "grafana" / "dashboards" / "livessl.json"

ONLY_SOMETIMES = (
    "livessl_array_clock_offset_seconds",
    "livessl_node_clock_error_seconds",
    "livessl_node_clock_synchronized",
    "livessl_node_load",
    "livessl_node_lost_blocks_total",
    "livessl_refused_total",
)
"""Metrics that a server need not have: of clocks that are not known yet, of machines whose clock says nothing of its
error, and of refusals where there were none."""

METRIC = re.compile(r"\b(?:livessl|process)_[a-z_]+\b")


def rules() -> list[dict[str, Any]]:
    return [rule for group in yaml.safe_load(RULES.read_text(encoding="utf-8"))["groups"] for rule in group["rules"]]


def dashboard_queries() -> list[str]:
    """Queries of the dashboard, with its variables filled in."""
    whole = json.loads(DASHBOARD.read_text(encoding="utf-8"))
    found = [target["expr"] for panel in whole["panels"] for target in panel.get("targets", ())]
    found += [annotation["expr"] for annotation in whole["annotations"]["list"]]
    return [query.replace("$instance", ".*").replace("$__rate_interval", "1m") for query in found]


@pytest.fixture(scope="module")
def observed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Prometheus]:
    """A Prometheus that has asked a server with clips, alerts and two located events several times."""
    folder = tmp_path_factory.mktemp("observed")
    alerts = {
        "actions": {"run": {**PATIENT, "command": ["true"]}},
        "rules": {"any": {"events": {}, "actions": ["run"]}},
    }
    site = alert_site(folder, {"server.clips": {"folder": "clips"}, "server.events_db": "events.sqlite"}, **alerts)
    configuration = yaml.safe_load((DEPLOY / "prometheus" / "prometheus.yml").read_text(encoding="utf-8"))
    configuration["global"] = {"scrape_interval": "300ms", "evaluation_interval": "300ms"}
    configuration["rule_files"] = [str(RULES)]
    with running_server(site) as server:
        target = server.url.removeprefix("http://")
        with running_prometheus(folder, target, configuration) as prometheus:
            wait_until(lambda: prometheus.values("livessl_uptime_seconds"), "a first answer of the server")
            capture_scene(server)
            wait_until(lambda: 2.0 in prometheus.values("livessl_events_total").values(), "both events")
            enough = "min(count_over_time(livessl_events_total[1h])) > 4"  # rates need several
            wait_until(lambda: prometheus.values(enough), "several answers")
            yield prometheus


@pytest.mark.parametrize("query", dashboard_queries())
def test_every_query_of_the_dashboard_has_a_result(observed: Prometheus, query: str) -> None:
    found = observed.span(query)
    known = set(observed.get("label/__name__/values"))
    missing = set(METRIC.findall(query)) - known
    assert missing <= set(ONLY_SOMETIMES), "no such metric"
    if not missing:
        assert found or query.startswith("resets"), "there was no second start"


def test_rules_are_valid_and_nothing_alerts_about_a_healthy_server(observed: Prometheus) -> None:
    loaded = [rule for group in observed.get("rules")["groups"] for rule in group["rules"]]
    assert [rule["name"] for rule in loaded] == [rule["alert"] for rule in rules()]
    assert {rule["health"] for rule in loaded} <= {"ok", "unknown"}
    known = set(observed.get("label/__name__/values"))
    for rule in rules():
        missing = set(METRIC.findall(rule["expr"])) - known
        assert missing <= set(ONLY_SOMETIMES), rule["alert"]
        assert {"summary", "cure"} <= set(rule["annotations"]), rule["alert"]


def series(name: str, values: str, **labels: str) -> dict[str, str]:
    inside = ", ".join(f'{key}="{value}"' for key, value in {"job": "livessl", "instance": "lab", **labels}.items())
    return {"series": f"{name}{{{inside}}}", "values": values}


ENABLED = series("livessl_array_enabled", "1x25", array="north")
CASES: dict[str, tuple[list[dict[str, str]], list[dict[str, str]]]] = {
    "LivesslServerDown": ([series("up", "0x25")], [series("up", "1x25")]),
    "LivesslArrayDead": (
        [ENABLED, series("livessl_array_up", "0x25", array="north")],
        [
            series("livessl_array_enabled", "0x25", array="north"),
            series("livessl_array_age_seconds", "99x25", array="north"),
        ],
    ),
    "LivesslArrayDegraded": (
        [ENABLED, series("livessl_array_up", "0x25", array="north")],
        [ENABLED, series("livessl_array_up", "1x25", array="north")],
    ),
    "LivesslFramesLost": (
        [series("livessl_array_total", "0+5x25", array="north", what="lost_frames")],
        [series("livessl_array_total", "0+5x25", array="north", what="frames")],
    ),
    "LivesslOverloaded": ([series("livessl_overload_level", "2x25")], [series("livessl_overload_level", "0x25")]),
    "LivesslResultsLate": (
        [series("livessl_fusion_delay_seconds", "3x25")],
        [series("livessl_fusion_delay_seconds", "0.02x25")],
    ),
    "LivesslClockNotSynchronized": (
        [series("livessl_node_clock_synchronized", "0x25", array="north")],
        [series("livessl_node_clock_synchronized", "1x25", array="north")],
    ),
    "LivesslClockOff": (
        [series("livessl_array_clock_offset_seconds", "-0.2x25", array="north", reference="south")],
        [series("livessl_node_clock_error_seconds", "0.001x25", array="north")],
    ),
    "LivesslEventsNotStored": (
        [series("livessl_events_unsaved", "7x25")],
        [series("livessl_events_unsaved", "0 3 0 0 2 0x20")],
    ),
    "LivesslAlertsGivenUp": (
        [series("livessl_alert_dead_letters", "1x25", action="guard")],
        [series("livessl_alert_dead_letters", "0x25", action="guard")],
    ),
    "LivesslSetUpFault": (
        [series("livessl_findings", "1x25", severity="error")],
        [series("livessl_findings", "1x25", severity="warning")],
    ),
    "LivesslReloadFailed": (
        [series("livessl_reload_successful", "0x25")],
        [series("livessl_reload_successful", "1x25")],
    ),
}
"""For each rule, series of a minute's steps with which it fires, and with which it does not."""


def test_each_rule_fires_for_its_fault_and_for_nothing_else(tmp_path: Path) -> None:
    require(PROMTOOL is not None, MISSING)
    assert set(CASES) == {rule["alert"] for rule in rules()}
    tests = []
    for name, (bad, good) in CASES.items():
        severity = next(rule["labels"]["severity"] for rule in rules() if rule["alert"] == name)
        for number, given in enumerate((bad, good)):
            expression = f'count(ALERTS{{alertname="{name}", alertstate="firing", severity="{severity}"}}) or vector(0)'
            wanted = [{"labels": "{}", "value": 1 - number}]
            check = {"expr": expression, "eval_time": "20m", "exp_samples": wanted}
            tests.append({"interval": "1m", "input_series": given, "promql_expr_test": [check], "name": name})
    path = tmp_path / "tests.yml"
    path.write_text(yaml.safe_dump({"rule_files": [str(RULES)], "tests": tests}), encoding="utf-8")
    for words in (("check", "rules", str(RULES)), ("test", "rules", str(path))):
        done = subprocess.run([str(PROMTOOL), *words], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
