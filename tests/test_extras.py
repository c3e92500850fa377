"""The extras of the package: `all` holds everything that users may need."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]
FOR_THIS_REPOSITORY = {"all", "benchmarks", "dev"}
"""Extras that are not for users: peers to compare with, and tools."""


def packages_of(extra: str) -> set[str]:
    """Return the names of the packages that an extra installs, through the extras that it names."""
    found: set[str] = set()
    for requirement in EXTRAS[extra]:
        inner = re.fullmatch(r"livessl\[(.+)\]", requirement)
        if inner is None:
            found.add(re.split(r"[\[<>=!~; ]", requirement)[0])
        else:
            found |= {name for part in inner[1].split(",") for name in packages_of(part.strip())}
    return found


def test_all_holds_every_extra_for_users() -> None:
    wanted = {name for extra in EXTRAS if extra not in FOR_THIS_REPOSITORY for name in packages_of(extra)}
    assert {"numba", "matplotlib", "pyarrow"} <= wanted
    assert packages_of("all") == wanted


def test_dev_holds_what_all_holds() -> None:
    """`scripts/setup.sh dev` is enough for every command."""
    assert packages_of("all") <= packages_of("dev")


def test_no_extra_repeats_a_dependency_of_the_core() -> None:
    core = {re.split(r"[\[<>=!~; ]", requirement)[0] for requirement in PROJECT["dependencies"]}
    assert core.isdisjoint(packages_of("all"))
