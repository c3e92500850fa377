"""Prometheus metrics of alerts: rules and deliveries."""

from __future__ import annotations

from collections.abc import Iterator

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from livessl.server.alerts.outbox import DeliveryState
from livessl.server.parts import Parts


def alert_metrics(parts: Parts) -> Iterator[Metric]:
    """Gauges and counters of rules and deliveries; none for a site without rules."""
    alerts = parts.alerts
    if not alerts.config.rules:
        return
    raised = CounterMetricFamily("livessl_alerts", "Alerts of the rule, restarts included.", labels=["rule"])
    suppressed = CounterMetricFamily(
        "livessl_alerts_suppressed", "Matches that did not alert, restarts included.", labels=["rule", "reason"]
    )
    armed = GaugeMetricFamily("livessl_alert_rule_armed", "1 while the rule is armed, otherwise 0.", labels=["rule"])
    for name, state in alerts.states.items():
        raised.add_metric([name], state.alerts)
        armed.add_metric([name], float(state.armed))
        for reason, count in state.suppressed.items():
            suppressed.add_metric([name, str(reason)], count)
    attempts = CounterMetricFamily(
        "livessl_alert_attempts", "Attempts to deliver an alert since the start.", labels=["action", "result"]
    )
    waiting = GaugeMetricFamily("livessl_alert_waiting", "Alerts that wait to be delivered.", labels=["action"])
    dead = GaugeMetricFamily("livessl_alert_dead_letters", "Alerts that were given up.", labels=["action"])
    counts = alerts.counts()
    for name, deliverer in alerts.deliverers.items():
        attempts.add_metric([name, "delivered"], deliverer.delivered)
        attempts.add_metric([name, "failed"], deliverer.failed)
        waiting.add_metric([name], counts.get((name, DeliveryState.WAITING), 0))
        dead.add_metric([name], counts.get((name, DeliveryState.DEAD), 0))
    yield from (raised, suppressed, armed, attempts, waiting, dead)
    yield CounterMetricFamily(
        "livessl_alert_events_unqueued",
        "Events that did not fit into the queue of the alerts; final ones were judged from the store instead.",
        alerts.unqueued,
    )
