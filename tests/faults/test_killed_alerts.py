"""The whole server, killed at random moments: every alert arrives, and changes are kept whole.

A change that was answered is there; one that was under way is made or not made, and nothing in between.
"""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from killed_alerts import play_killed
from processes import make_recordings

pytestmark = pytest.mark.processes

KILLS = 2
SOUNDS = 5


def test_alerts_and_changes_survive_kills_of_the_whole_server(tmp_path: Path) -> None:
    seed = random.randrange(10**6)
    print(f"seed {seed}")
    make_recordings(tmp_path / "recordings", SOUNDS, gap_s=1.2)
    outcome = play_killed(tmp_path / "recordings", tmp_path / "site", KILLS, seed)
    print(outcome)
    assert outcome.kills >= KILLS
    assert outcome.interrupted > 0
    assert outcome.sounds == SOUNDS
    assert 0 < len(outcome.wanted) < SOUNDS, "some sounds are in the excluded zone, and some are not"
    assert outcome.missing == []
    assert outcome.accepted.keys() == outcome.wanted
    assert (outcome.differing, outcome.unwanted, outcome.forgotten) == (0, [], [])
    assert outcome.changes > KILLS
