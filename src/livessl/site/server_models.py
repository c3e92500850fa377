"""Keys and defaults of `server` and `store` in the site file: addresses and ports, TLS, sinks, clips, retention.

Those of `server.hub` are in `hub_models`.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field, field_validator, model_validator

from livessl.core.states import Status
from livessl.site.addresses import (
    check_endpoint,
    check_host,
    check_network,
    check_origin,
    check_root_path,
    check_trusted_host,
)
from livessl.site.fields import FileName, Model, Positive
from livessl.site.history_place import check_history_place
from livessl.site.hub_models import HubLinkConfig
from livessl.site.sink_types import check_sink_type


class HttpConfig(Model):
    """Address, names, access tokens and certificate of the API and the dashboard."""

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    trusted_hosts: tuple[str, ...] = ()
    root_path: str = ""
    forwarded_allow_ips: tuple[str, ...] = ("127.0.0.1", "::1")
    allowed_origins: tuple[str, ...] = ()
    frame_ancestors: tuple[str, ...] = ()
    tokens: FileName | None = None
    certificate: FileName | None = None
    private_key: FileName | None = None

    @field_validator("host")
    @classmethod
    def _host(cls, host: str) -> str:
        return check_host(host)

    @field_validator("trusted_hosts")
    @classmethod
    def _trusted(cls, hosts: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(check_trusted_host(host) for host in hosts)

    @field_validator("allowed_origins", "frame_ancestors")
    @classmethod
    def _origins(cls, origins: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(check_origin(origin) for origin in origins)

    @field_validator("root_path")
    @classmethod
    def _root(cls, path: str) -> str:
        return check_root_path(path)

    @field_validator("forwarded_allow_ips")
    @classmethod
    def _proxies(cls, networks: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(check_network(network) for network in networks)

    @model_validator(mode="after")
    def _pair(self) -> HttpConfig:
        if (self.certificate is None) != (self.private_key is None):
            raise ValueError(
                "expected certificate and private_key, got "
                f"{'private_key' if self.certificate is None else 'certificate'} alone; add the other one"
            )
        return self


class SinkConfig(Model):
    """A sink: a further destination of events. `livessl.site.sink_types` has the types."""

    type: Annotated[str, AfterValidator(check_sink_type)]
    path: FileName


class ClipsConfig(Model):
    """Clips: of which events sound is stored, by their statuses, and for how long."""

    folder: FileName
    of: Annotated[tuple[Status, ...], Field(min_length=1)] = tuple(Status)
    pre_s: Annotated[float, Field(ge=0, le=5)] = 1.0
    post_s: Annotated[float, Field(ge=0, le=5)] = 0.5
    max_age_days: Positive | None = 30.0
    max_bytes: Annotated[int, Field(ge=1_000_000)] = 10_000_000_000
    enhanced: bool = True


class ServerConfig(Model):
    """The fusion server."""

    bind: str = "tcp://127.0.0.1:5570"
    http: HttpConfig = HttpConfig()
    events_db: Annotated[str | None, AfterValidator(check_history_place)] = None
    sinks: tuple[SinkConfig, ...] = ()
    clips: ClipsConfig | None = None
    listen: bool = False
    hub: HubLinkConfig | None = None

    @field_validator("bind")
    @classmethod
    def _endpoint(cls, endpoint: str) -> str:
        return check_endpoint(endpoint, wildcards=True)


class StoreConfig(Model):
    """Retention of events in days; with None, events are never deleted."""

    retention_days: Positive | None = None
