"""The hub's own file: its keys and defaults (port, retention, limits of the stream); reports all faults at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import AfterValidator, Field, ValidationError

from livessl.errors import ConfigError, Fault
from livessl.site.addresses import is_loopback
from livessl.site.fields import Model, Positive
from livessl.site.findings import Locator, duplicate_keys, nodes_of, reason, validation_findings, value_of
from livessl.site.history_place import check_history_place, is_url
from livessl.site.hub_models import HallName, NatsConfig
from livessl.site.server_models import HttpConfig


def _place(name: str) -> str:
    checked = check_history_place(name)
    assert checked is not None
    return checked


SiteName = Annotated[str, Field(min_length=1, max_length=200)]


class StreamConfig(Model):
    """Limits of the stream in NATS: on how many servers it keeps messages, how long, and how much."""

    replicas: Annotated[int, Field(ge=1, le=5)] = 1
    max_age_days: Positive = 30.0
    max_bytes: Annotated[int, Field(ge=10_000_000)] = 10_000_000_000


class HubHttpConfig(HttpConfig):
    """Address, names, access tokens and certificate of the hub's API and page."""

    port: Annotated[int, Field(ge=0, le=65535)] = 8100


class HubFile(Model):
    """The hub's file; `halls` lists the sites of each hall, whose events are compared with each other."""

    hub: Annotated[str, Field(min_length=1, max_length=64)] = "hub"
    nats: NatsConfig
    stream: StreamConfig = StreamConfig()
    database: Annotated[str, AfterValidator(_place)]
    http: HubHttpConfig = HubHttpConfig()
    retention_days: Positive | None = None
    halls: dict[HallName, Annotated[tuple[SiteName, ...], Field(min_length=1)]] = Field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Hub:
    """A hub's settings, and the folder of its file."""

    settings: HubFile
    directory: Path

    @property
    def database(self) -> Path | str:
        """The SQLite file of the history, or the URL of its PostgreSQL database."""
        name = self.settings.database
        return name if is_url(name) else self.file(name)

    def file(self, name: str) -> Path:
        """Return the path of a file that the hub's file names, relative to its folder."""
        return self.directory / name


def load_hub(path: Path) -> Hub:
    """Read and check a hub's file.

    Raises
    ------
    ConfigError
        With every fault found, each with its line.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError([Fault(str(path), f"cannot be read: {reason(error)}")]) from error
    return parse_hub(text, str(path), path.parent)


def parse_hub(text: str, source: str = "hub.yaml", directory: Path | None = None) -> Hub:
    """Check the text of a hub's file; `source` is its name in messages.

    Raises
    ------
    ConfigError
        With every fault found, each with its line.
    """
    try:
        root = nodes_of(text)
        data = value_of(root)
    except RecursionError as error:
        raise ConfigError([Fault(source, "an alias contains itself, or nesting is too deep")]) from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{source}:{mark.line + 1}" if mark else source
        raise ConfigError([Fault(where, f"not valid YAML: {getattr(error, 'problem', error)}")]) from error
    if not isinstance(data, dict):
        raise ConfigError([Fault(source, "expected a mapping with the keys nats and database")])
    locator, settings = Locator(source, root), None
    errors: list[Any] = []
    try:
        settings = HubFile.model_validate(data, context=errors)
    except ValidationError as error:
        errors += error.errors()
    findings = [*duplicate_keys(root), *validation_findings(HubFile, errors)]
    if settings is not None and not is_loopback(settings.http.host) and settings.http.tokens is None:
        what = (
            f"{settings.http.host!r} can be reached from other machines, and anyone there could look: set http.tokens: "
            "tokens.yaml, or use 127.0.0.1"
        )
        findings.append((("http", "host"), what))
    if settings is None or findings:
        raise ConfigError([locator.fault(place, what) for place, what in findings])
    return Hub(settings, Path() if directory is None else directory)
