"""Delivers alerts by MQTT: topics, availability with a last will, and discovery by Home Assistant."""

from __future__ import annotations

import asyncio
import hashlib
import logging
import re
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any, Final

import orjson

from livessl import __version__
from livessl.server.alerts.actions import ActionSetting, DeliveryError, client_tls, optional_library
from livessl.server.api.encode import JsonObject
from livessl.site.secret_files import read_secret

if TYPE_CHECKING:
    import aiomqtt

ONLINE: Final = "online"
OFFLINE: Final = "offline"
"""Payloads of the availability topic, which Home Assistant expects by default."""

EVENT_TYPE: Final = "alert"
"""The only type of event of each entity."""

FIRST_WAIT_S: Final = 0.5
LONGEST_WAIT_S: Final = 30.0
"""Shortest and longest wait, in seconds, between two attempts to reach the broker."""

GOODBYE_S: Final = 1.0
"""Longest time, in seconds, that the last message of a server that stops may take."""

_log = logging.getLogger(__name__)


class Mqtt:
    """Publishes alerts, and keeps a connection; if it ends, the broker announces that.

    Parameters
    ----------
    setting : ActionSetting

    Raises
    ------
    ConfigError
        If aiomqtt is not installed, or the password or the certificates cannot be read.
    """

    def __init__(self, setting: ActionSetting) -> None:
        config = setting.config.mqtt
        assert config is not None
        self._aiomqtt = optional_library(setting, "aiomqtt")
        self._setting = setting
        self._discovery = config.discovery
        self._topic = config.topic or f"livessl/{setting.site.site}"
        self._host = config.host
        self._port = config.port or (8883 if config.tls else 1883)
        self._username = config.username
        self._password = None
        if config.password is not None:
            self._password = read_secret(setting.site.file(config.password), "write the password into it").strip()
        self._tls = client_tls(setting, config.ca) if config.tls else None
        self._client: aiomqtt.Client | None = None
        self._problem = "not connected yet"

    @property
    def availability_topic(self) -> str:
        """The topic of the server's availability."""
        return f"{self._topic}/availability"

    @asynccontextmanager
    async def connected(self, ready: Callable[[], None]) -> AsyncIterator[None]:
        """Keep a connection to the broker, and call `ready` after each new connection."""
        keeping = asyncio.create_task(self._keep(ready))
        try:
            yield
        finally:
            keeping.cancel()
            await asyncio.gather(keeping, return_exceptions=True)

    async def deliver(self, alert: JsonObject) -> None:
        """Publish an alert, and wait until the broker confirms it.

        Raises
        ------
        DeliveryError
            If there is no connection, or the broker does not confirm the message in time.
        """
        client = self._client
        if client is None:
            raise DeliveryError(f"no connection to {self._host}:{self._port}: {self._problem}")
        payload = orjson.dumps({"event_type": EVENT_TYPE, **alert})
        try:
            await client.publish(
                self._rule_topic(alert["rule"]), payload, qos=1, timeout=self._setting.config.timeout_s
            )
        except self._aiomqtt.MqttError as error:
            raise DeliveryError(f"{self._host}:{self._port} did not confirm it: {error}") from error

    def discovery_payload(self, rule: str) -> JsonObject:
        """Return the message that makes Home Assistant show a rule as an event entity."""
        site = self._setting.site.site
        return {
            "name": rule,
            "unique_id": f"livessl_{_slug(site)}_{_slug(rule)}",
            "state_topic": self._rule_topic(rule),
            "event_types": [EVENT_TYPE],
            "availability_topic": self.availability_topic,
            "icon": "mdi:ear-hearing",
            "qos": 1,
            "device": {
                "identifiers": [f"livessl_{_slug(site)}"],
                "name": f"livessl {site}",
                "manufacturer": "livessl",
                "sw_version": __version__,
                "configuration_url": f"{self._setting.url}/",
            },
            "origin": {"name": "livessl", "sw_version": __version__},
        }

    def _rule_topic(self, rule: str) -> str:
        return f"{self._topic}/alerts/{rule}"

    async def _keep(self, ready: Callable[[], None]) -> None:
        """Connect again whenever the connection ends, until cancelled."""
        wait_s = FIRST_WAIT_S
        while True:
            try:
                async with self._new_client() as client:
                    await self._introduce(client)
                    _log.info("%s: connected to %s:%d", self._setting.place, self._host, self._port)
                    wait_s = FIRST_WAIT_S
                    await self._until_disconnected(client, ready)
            except Exception as error:  # noqa: BLE001  # libraries below raise others, too: for a host that is no name
                if str(error) != self._problem:
                    _log.warning("%s: %s:%d: %s; trying again", self._setting.place, self._host, self._port, error)
                self._problem = str(error)
            await asyncio.sleep(wait_s)
            wait_s = min(2.0 * wait_s, LONGEST_WAIT_S)

    def _new_client(self) -> aiomqtt.Client:
        client: aiomqtt.Client = self._aiomqtt.Client(
            self._host,
            self._port,
            username=self._username,
            password=self._password,
            tls_context=self._tls,
            timeout=self._setting.config.timeout_s,
            will=self._aiomqtt.Will(self.availability_topic, OFFLINE, qos=1, retain=True),
        )
        return client

    async def _introduce(self, client: aiomqtt.Client) -> None:
        """Publish the server's availability and the discovery message of each rule; the broker retains them.

        An empty message makes Home Assistant remove a rule that is no longer published here.
        """
        shown = {rule: orjson.dumps(self.discovery_payload(rule)) for rule in self._setting.rules}
        if self._discovery:
            for rule, payload in {**dict.fromkeys(self._setting.other_rules, b""), **shown}.items():
                topic = f"{self._discovery}/event/livessl_{_slug(self._setting.site.site)}/{_slug(rule)}/config"
                await client.publish(topic, payload, qos=1, retain=True)
        await client.publish(self.availability_topic, ONLINE, qos=1, retain=True)

    async def _until_disconnected(self, client: aiomqtt.Client, ready: Callable[[], None]) -> None:
        self._client = client
        ready()
        try:
            async for _ in client.messages:
                pass  # nothing is subscribed to; the iteration ends with the connection
        except asyncio.CancelledError:
            with suppress(self._aiomqtt.MqttError):
                await client.publish(self.availability_topic, OFFLINE, qos=1, retain=True, timeout=GOODBYE_S)
            raise
        finally:
            self._client = None


def _slug(name: Any) -> str:
    """Return a name in the characters that discovery topics may have; different names stay different."""
    clean = re.sub(r"[^A-Za-z0-9_-]", "_", str(name))
    return clean if clean == name else f"{clean}_{hashlib.sha256(str(name).encode()).hexdigest()[:6]}"
