"""The page about the fields of messages has a row for every field of the models, and the files that it names exist."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import pytest
from pydantic import BaseModel

from livessl.schema import alerts, answers, clips, findings, messages, relocation, reports, values, zones

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "fields.md"
SECTIONS: Final[Mapping[str, type[BaseModel]]] = {
    "Event": values.Event,
    "Update": messages.UpdateMessage,
    "Contribution": values.Contribution,
    "Stages of the latency": values.LatencyStages,
    "Candidate": values.Candidate,
    "Membership": values.Membership,
    "Other source": values.OtherSource,
    "Track": values.Track,
    "Change of a track in a zone": zones.ZoneChange,
    "Array": values.Array,
    "Place of an array": answers.PlacedArray,
    "Agreement": values.Agreement,
    "Clock offset": values.ClockOffset,
    "Counters": values.Counters,
    "Channel": reports.Channel,
    "Host": reports.Host,
    "Alert": alerts.Alert,
    "Array of an alert": alerts.AlertedArray,
    "Links of an alert": alerts.OpenLinks,
    "Delivery": alerts.Delivery,
    "Rule": alerts.Rule,
    "Finding": findings.Finding,
    "Blind spot": findings.BlindSpot,
    "Answer of relocate": relocation.LocationAnswer,
    "Both answers of relocate": relocation.Relocated,
    "Heat map": answers.HeatMap,
    "Health": answers.Health,
    "Load": answers.Load,
    "Recording of a clip": clips.ClipFile,
    "Beam of a clip": clips.ClipBeam,
}
EXPLAINED_ABOVE: Final[Mapping[str, set[str]]] = {
    "Update": {"v", "seq", *values.Event.model_fields},  # seq and v are of the connection
    "Place of an array": {*values.Array.model_fields},
}
"""Fields of a model that another section explains, or that are of the connection."""


def sections(text: str) -> dict[str, list[list[str]]]:
    """Return the rows of the table below each heading: cells of field, words and files."""
    return {
        title: [
            [cell.strip() for cell in row.strip("| ").split("|")]
            for row in re.findall(r"^\|(?!-)(.+)\|$", body, re.MULTILINE)[1:]
        ]
        for title, body in re.findall(r"^## (.+)\n((?:(?!^## ).*\n?)*)", text, re.MULTILINE)
    }


def named(rows: list[list[str]]) -> list[str]:
    """Return the fields that the rows are about."""
    return [name for row in rows for name in re.findall(r"`(\w+)`", row[0])]


@pytest.mark.parametrize("title", SECTIONS)
def test_every_field_of_a_model_has_one_row(title: str) -> None:
    fields = set(SECTIONS[title].model_fields) - EXPLAINED_ABOVE.get(title, set())
    assert Counter(named(sections(PAGE.read_text(encoding="utf-8"))[title])) == Counter(fields)


def test_a_finding_in_an_alert_has_the_fields_of_a_finding() -> None:
    assert alerts.AlertedFinding.model_fields.keys() == findings.Finding.model_fields.keys()


def test_the_page_has_no_other_sections() -> None:
    assert sections(PAGE.read_text(encoding="utf-8")).keys() == SECTIONS.keys()


def test_every_row_names_a_file_or_a_section_and_the_files_exist() -> None:
    rows = [row for rows in sections(PAGE.read_text(encoding="utf-8")).values() for row in rows]
    files = [re.findall(r"`([\w/]+\.py)`", row[-1]) for row in rows]
    assert len(rows) > 80
    assert [row for row, named in zip(rows, files, strict=True) if not named and not row[-1].startswith("see [")] == []
    missing = {name for named in files for name in named if not (ROOT / "src" / "livessl" / name).exists()}
    assert missing == set()


def test_a_field_without_a_row_and_one_that_is_gone_are_found() -> None:
    head = "# Page\n\n## Array\n\n| field | in words | computed in |\n|---|---|---|\n"
    text = head + "| `a`, `b` | | `x.py` |\n| `c` | d | `y.py` |\n"
    assert named(sections(text)["Array"]) == ["a", "b", "c"]
    assert sections(text)["Array"][0][-1] == "`x.py`"
