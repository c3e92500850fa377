"""REST routes of alerts: rules, arming, alerts with pictures, dead letters, dry run."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Final

from fastapi import APIRouter, HTTPException, Path, Query, Request, Response

from livessl.clock import utc_text
from livessl.schema import alerts as alert_schema
from livessl.schema.answers import errors
from livessl.server.alerts.dead_letters import DeadLetters
from livessl.server.alerts.history import DryRun, DryRunBusyError
from livessl.server.alerts.outbox import Delivery, DeliveryState, OutboxError
from livessl.server.alerts.picture import DEFAULT_PX, MAX_PX
from livessl.server.alerts.rules import SUPPRESSED, RuleState
from livessl.server.alerts.schedule import is_open
from livessl.server.api.encode import API_VERSION, JsonObject
from livessl.server.api.routes import as_json
from livessl.server.parts import Parts
from livessl.site.alert_models import AlertsConfig

DAY_NS: Final = 86_400_000_000_000

DRY_RUN_RETRY_S: Final = 5
"""Wait, in seconds, that is asked of a client whose dry run found another one under way."""

_BINARY: Final = {"type": "string", "format": "binary"}
_NO_PICTURE: Final = "There is no alert of that key, or it is about no place."
_NO_RULE: Final = "There is no rule of that name."
_NOT_ON_EVENTS: Final = "There is no rule of that name on events: only events are stored."
_NO_LETTER: Final = "There is no dead letter of that number, or the site file does not have its action."
_OUTBOX: Final = "The outbox cannot be read or written."
_log = logging.getLogger(__name__)


def alert_routes(parts: Parts) -> APIRouter:
    """Alerts with their pictures, and the rules."""
    alerts, router = parts.alerts, APIRouter(prefix="/api/v1/alerts", tags=["alerts"])
    drawing = threading.Lock()  # one picture at a time, for the memory and the processor

    @router.get(
        "", response_model=alert_schema.AlertPage, responses=errors(404, 503, texts={404: _NO_RULE, 503: _OUTBOX})
    )
    def get_alerts(
        rule: Annotated[str | None, Query(description="only alerts of this rule")] = None,
        limit: Annotated[int, Query(ge=1, le=1000, description="most alerts on a page")] = 50,
        before: Annotated[
            int | None, Query(ge=0, le=2**63 - 1, description="`next_before` of the previous page")
        ] = None,
    ) -> Response:
        """Alerts with their deliveries, newest first."""
        if rule is not None:
            _check_rule(parts, rule)
        with _outbox_errors():
            rows = alerts.outbox.recent(limit + 1, before, rule)
            deliveries = alerts.outbox.deliveries([alert["key"] for _, alert in rows[:limit]])
        found = [
            {**alert, "deliveries": [_delivery(each) for each in deliveries[alert["key"]]]} for _, alert in rows[:limit]
        ]
        next_before = rows[limit - 1][0] if len(rows) > limit else None
        return as_json({"v": API_VERSION, "alerts": found, "next_before": next_before})

    @router.get(
        "/{key}/picture.png",
        response_class=Response,
        responses={
            200: {"description": "The picture.", "content": {"image/png": {"schema": _BINARY}}},
            **errors(404, 503, texts={404: _NO_PICTURE, 503: _OUTBOX}),
        },
    )
    def get_picture(
        key: str,
        size: Annotated[int, Query(ge=64, le=MAX_PX, description="length of the longer side in pixels")] = DEFAULT_PX,
    ) -> Response:
        """The floor plan with arrays, zones, and the place of an alert with its ellipse of 95 %."""
        with _outbox_errors():
            alert = alerts.outbox.get(key)
        with drawing:
            picture = None if alert is None else alerts.evidence.picture(alert, size)
        if picture is None:
            raise HTTPException(404, f"no alert {key!r} about a place; GET alerts lists them")
        return Response(picture, media_type="image/png", headers={"Cache-Control": "private, max-age=60"})

    _add_rule_routes(router, parts)
    return router


def _add_rule_routes(router: APIRouter, parts: Parts) -> None:
    """Add the routes of rules: their states, their switches, and the dry run."""
    alerts = parts.alerts

    @router.get("/rules", response_model=alert_schema.Rules)
    def get_rules() -> Response:
        """The site's rules and their states."""
        config, states, now_ns = alerts.config, alerts.states, parts.clock.now_ns()
        found = [_rule(config, name, states[name], now_ns) for name in config.rules if name in states]
        return as_json({"v": API_VERSION, "rules": found})

    @router.put(
        "/rules/{name}/armed",
        response_model=alert_schema.Armed,
        responses=errors(400, 404, 411, 413, 503, texts={404: _NO_RULE, 503: _OUTBOX}),
    )
    def put_armed(name: str, switch: alert_schema.ArmSwitch, request: Request) -> Response:
        """Arm or disarm a rule; for operators."""
        _check_rule(parts, name)
        with _outbox_errors():
            alerts.arm(name, switch.armed)
        who, done = request.scope["client_name"], "armed" if switch.armed else "disarmed"
        _log.info("%r has %s rule %r", who, done, name)
        parts.journal.configuration(f"rule {name}", who, f"{who!r} has {done} rule {name!r}", switch.model_dump())
        return as_json({"v": API_VERSION, "name": name, "armed": switch.armed})

    @router.get(
        "/rules/{name}/dry-run",
        response_model=alert_schema.Tried,
        responses=errors(404, 503, texts={404: _NOT_ON_EVENTS, 503: "Another dry run is under way."}),
    )
    def get_dry_run(
        name: str, days: Annotated[float, Query(gt=0, le=3660, description="length of the span that ends now")] = 7.0
    ) -> Response:
        """Try a rule on the stored events: how often it would have alerted."""
        _check_rule(parts, name)
        if alerts.config.rules[name].events is None:
            raise HTTPException(404, f"rule {name!r} is not on events, and only events are stored")
        now_ns = parts.clock.now_ns()
        since_ns = now_ns - round(days * DAY_NS)
        try:
            tried = alerts.dry_runs.run(name, since_ns, now_ns)
        except DryRunBusyError as error:
            headers = {"Retry-After": str(DRY_RUN_RETRY_S)}
            raise HTTPException(503, "another dry run is under way; try again when it has ended", headers) from error
        return as_json({"v": API_VERSION, "name": name, **_tried(name, tried, days, since_ns, now_ns)})


def dead_letter_routes(parts: Parts) -> APIRouter:
    """Alerts that an action has given up: they can be delivered again, or dismissed."""
    router, letters = APIRouter(prefix="/api/v1/alerts", tags=["alerts"]), parts.alerts.dead_letters
    _add_dead_letters(router, letters)
    _add_resending(router, letters)
    _add_dismissal(router, letters)
    return router


def _add_dead_letters(router: APIRouter, letters: DeadLetters) -> None:
    @router.get(
        "/dead-letters", response_model=alert_schema.DeadLetterPage, responses=errors(503, texts={503: _OUTBOX})
    )
    def get_dead_letters(
        limit: Annotated[int, Query(ge=1, le=1000, description="most dead letters on a page")] = 50,
        before: Annotated[
            int | None, Query(ge=0, le=2**63 - 1, description="`next_before` of the previous page")
        ] = None,
    ) -> Response:
        """Alerts that an action has given up, newest first."""
        with _outbox_errors():
            rows = letters.page(limit + 1, before)
        found = [{**_delivery(delivery), "alert": alert} for delivery, alert in rows[:limit]]
        next_before = rows[limit - 1][0].number if len(rows) > limit else None
        return as_json({"v": API_VERSION, "dead_letters": found, "next_before": next_before})


def _add_resending(router: APIRouter, letters: DeadLetters) -> None:
    @router.post(
        "/dead-letters/{number}/resend",
        response_model=alert_schema.Resent,
        responses=errors(404, 411, 413, 503, texts={404: _NO_LETTER, 503: _OUTBOX}),
    )
    def post_resend(number: Annotated[int, Path(ge=1, le=2**63 - 1)], request: Request) -> Response:
        """Deliver a dead letter again; for operators."""
        with _outbox_errors():
            try:
                letters.resend(number)
            except LookupError as error:
                raise HTTPException(404, str(error)) from error
        _log.info("%r has sent dead letter %d again", request.scope["client_name"], number)
        return as_json({"v": API_VERSION, "number": number})


def _add_dismissal(router: APIRouter, letters: DeadLetters) -> None:
    @router.delete(
        "/dead-letters/{number}",
        response_model=alert_schema.Dismissed,
        responses=errors(404, 411, 413, 503, texts={404: "There is no dead letter of that number.", 503: _OUTBOX}),
    )
    def delete_dead_letter(number: Annotated[int, Path(ge=1, le=2**63 - 1)], request: Request) -> Response:
        """Dismiss a dead letter, so that it is not delivered any more; for operators."""
        with _outbox_errors():
            found = letters.dismiss(number)
        if not found:
            raise HTTPException(404, f"no dead letter {number}; GET alerts/dead-letters lists them")
        _log.info("%r has dismissed dead letter %d", request.scope["client_name"], number)
        return as_json({"v": API_VERSION, "dismissed": found})

    @router.delete(
        "/dead-letters", response_model=alert_schema.Dismissed, responses=errors(411, 413, 503, texts={503: _OUTBOX})
    )
    def delete_dead_letters(
        request: Request,
        action: Annotated[str | None, Query(description="only those of this action; all if absent")] = None,
    ) -> Response:
        """Dismiss all dead letters, or those of an action, which the site need not have any more; for operators."""
        with _outbox_errors():
            found = letters.dismiss(action=action)
        _log.info("%r has dismissed %d dead letters", request.scope["client_name"], found)
        return as_json({"v": API_VERSION, "dismissed": found})


def _check_rule(parts: Parts, name: str) -> None:
    rules = parts.alerts.config.rules
    if name not in rules:
        listed = f"rules are {', '.join(rules)}" if rules else "this site has no rules"
        raise HTTPException(404, f"no rule {name!r}; {listed}")


@contextmanager
def _outbox_errors() -> Iterator[None]:
    """Answer 503 where the outbox does not work."""
    try:
        yield
    except OutboxError as error:
        raise HTTPException(503, str(error)) from error


def _delivery(delivery: Delivery) -> JsonObject:
    waits = delivery.state is DeliveryState.WAITING
    return {
        "number": delivery.number,
        "action": delivery.action,
        "state": str(delivery.state),
        "attempts": delivery.attempts,
        "next_utc": utc_text(delivery.next_ns) if waits else None,
        "error": delivery.error,
    }


def _rule(config: AlertsConfig, name: str, state: RuleState, now_ns: int) -> JsonObject:
    rule = config.rules[name]
    return {
        "name": name,
        "watches": rule.kind,
        "armed": state.armed,
        "open_now": is_open(rule.schedule, now_ns, config.timezone),
        "actions": list(rule.actions),
        "alerts": state.alerts,
        "last_utc": None if state.last_ns is None else utc_text(state.last_ns),
        "suppressed": _suppressed(state.suppressed),
        "ongoing": list(state.ongoing),
    }


def _tried(name: str, tried: DryRun, days: float, since_ns: int, until_ns: int) -> JsonObject:
    times = "once" if tried.alerts == 1 else f"{tried.alerts} times"
    span = "day" if days == 1 else f"{days:g} days"
    return {
        "since_utc": utc_text(since_ns),
        "until_utc": utc_text(until_ns),
        "events": tried.events,
        "matched": tried.matched,
        "alerts": tried.alerts,
        "suppressed": _suppressed(tried.suppressed),
        "latest": [{"event_id": event["id"], "time_utc": event["time_utc"]} for event in tried.latest],
        "complete": tried.complete,
        "text": f"rule {name!r} would have alerted {times} in the last {span}",
    }


def _suppressed(counts: Mapping[str, int]) -> JsonObject:
    return {str(verdict).replace("-", "_"): counts.get(verdict, 0) for verdict in SUPPRESSED}
