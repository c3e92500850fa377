"""Keys and defaults of the connection to NATS: `server.hub` of a site file, and `nats` of the hub's own file."""

from __future__ import annotations

from typing import Annotated, Final
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field, field_validator, model_validator

from livessl.site import polygon
from livessl.site.addresses import is_loopback
from livessl.site.fields import Coordinate, FileName, Model

FORM: Final = "expected tls://HOST:PORT, or nats://HOST:PORT on this machine"


def _server(url: str) -> str:
    """Return the URL of a NATS server to which passwords and events can be sent."""
    try:
        parts = urlsplit(url)
        _ = parts.port
    except ValueError as error:
        raise ValueError(f"{FORM}, got a URL with {error}") from error
    if parts.username is not None or parts.password is not None:
        raise ValueError(f"{FORM}, got a URL with a user; set user, and password to the name of a file")
    if parts.scheme not in ("nats", "tls") or not parts.hostname:
        raise ValueError(f"{FORM}, got {url!r}")
    if parts.scheme == "nats" and not is_loopback(parts.hostname):
        raise ValueError(
            f"{FORM}, got {url!r}: without TLS, others could read events and passwords on the way; "
            "use tls://, or a leaf node on this machine"
        )
    return url


Server = Annotated[str, AfterValidator(_server)]


HallName = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9._-]+$")]


class NatsConfig(Model):
    """Addresses of NATS servers, and what this program identifies itself with."""

    servers: Annotated[tuple[Server, ...], Field(min_length=1)]
    user: str | None = None
    password: FileName | None = None
    credentials: FileName | None = None
    ca: FileName | None = None
    certificate: FileName | None = None
    private_key: FileName | None = None

    @model_validator(mode="after")
    def _pairs(self) -> NatsConfig:
        for one, other in (("user", "password"), ("certificate", "private_key")):
            given = [name for name in (one, other) if getattr(self, name) is not None]
            if len(given) == 1:
                raise ValueError(f"expected {one} and {other}, got {given[0]} alone; add the other one")
        if self.user is not None and self.credentials is not None:
            raise ValueError("expected either user and password or credentials, got both; remove one")
        return self


class HallConfig(Model):
    """The hall that several servers share, and the part of its floor plan, in metres, that belongs to this server.

    All servers of a hall use the coordinates of the hall.
    """

    name: HallName
    tile_m: tuple[tuple[Coordinate, Coordinate], ...]

    @field_validator("tile_m")
    @classmethod
    def _simple(cls, points: tuple[polygon.Point, ...]) -> tuple[polygon.Point, ...]:
        if len(points) > 3 and points[0] == points[-1]:
            points = points[:-1]  # a closed ring, as other programs write it
        faults = polygon.polygon_faults(points)
        if faults:
            raise ValueError(
                f"expected a polygon with {'; '.join(faults)}; give the corners [x, y] of the tile in order around it"
            )
        return points


class HubLinkConfig(NatsConfig):
    """The connection of a site's server to a hub, where on Earth the site is, and its part of a hall."""

    location_deg: tuple[Annotated[float, Field(ge=-90, le=90)], Annotated[float, Field(ge=-180, le=180)]] | None = None
    hall: HallConfig | None = None
