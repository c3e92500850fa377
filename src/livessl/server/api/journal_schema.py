"""API models of the journal, which has what the history keeps besides events."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, Field

from livessl.schema.values import UtcTime, Version
from livessl.server.history.journal import EntryKind


class JournalEntry(BaseModel):
    """An alert, a track that has ended, or a change of an array's state or of the configuration."""

    kind: EntryKind = Field(description="What it is.")
    name: str = Field(
        description="What it is about: the rule, the number of the track, the array, or what was changed.",
        examples=["door-at-night"],
    )
    time_utc: UtcTime = Field(description="When it happened; of a track, when it began.")
    text: str = Field(description="The same in a sentence.", examples=["array 'north' is lost after healthy"])
    detail: dict[str, Any] = Field(
        description="`alert`: the alert. `track`: `track_id`, `start_utc`, `end_utc`, `duration_s`, `updates`, `zones` "
        "and `path`, a list of [seconds since the start, x, y, z] in metres. `array`: `state`, `before` and `reason`. "
        "`configuration`: `client`, and the new setting."
    )


class JournalAnswer(BaseModel):
    """A page of the journal, newest first."""

    v: Version
    entries: list[JournalEntry] = Field(description="Entries, newest first.")
    next_cursor: str | None = Field(
        description="Pass it unchanged as `cursor` for the next page; null at the end.",
        examples=["1767225600123456789-17"],
    )
