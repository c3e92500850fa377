"""What is shed under simulated load: the order, the hysteresis, and the choice of the clearest arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.core.stream.load_policy import (
    BEHIND_S,
    CALM_S,
    HOLD_NS,
    IDLE_HOLD_NS,
    INTERVAL_NS,
    JOIN_FACTOR,
    LEVELS,
    LONGEST_HOLD_NS,
    Clearest,
    LoadPolicy,
)

TURN_NS = 20_000_000
ORDER = ("updates", "second_looks", "maps", "arrays", "quiet")


def hold(policy: LoadPolicy, seconds: float, delay_s: float, *, busy: float = 1.0, since_ns: int = 0) -> int:
    """Note the same delay at every turn for a time; return the time at its end."""
    now_ns = since_ns
    while now_ns < since_ns + seconds * 1e9:
        now_ns += TURN_NS
        policy.note(delay_s, busy, now_ns)
    return now_ns


@dataclass
class Machine:
    """A fusion that needs a time for each second of sound, less at each level, and a queue in front of it."""

    cost: Callable[[int], float]
    policy: LoadPolicy = field(default_factory=LoadPolicy)
    now_s: float = 0.0
    queue_s: float = 0.0
    delays_s: list[float] = field(default_factory=list)
    levels: list[int] = field(default_factory=list)

    def run(self, seconds: float, load: float = 1.0) -> None:
        """Receive sound for a time; `load` multiplies its cost. Only the first second of queued sound is kept."""
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            step_s = 0.05
            cost = load * self.cost(self.policy.level)
            self.queue_s = min(1.0, max(0.0, self.queue_s + step_s * (cost - 1.0) / max(cost, 1.0)))
            self.now_s += step_s
            self.policy.note(self.queue_s, min(1.0, cost), round(self.now_s * 1e9))
            self.delays_s.append(self.queue_s)
            self.levels.append(self.policy.level)


def test_each_level_sheds_what_the_one_before_sheds_and_more() -> None:
    assert LEVELS[0].shed == ()
    for before, after in pairwise(LEVELS):
        assert before != after
        assert set(before.shed) <= set(after.shed)
        assert before.arrays is None or (after.arrays is not None and after.arrays <= before.arrays)
        assert before.update_every is not None
        assert after.update_every is None or after.update_every >= before.update_every


def test_updates_are_shed_first_then_second_looks_then_maps_then_arrays_then_quiet() -> None:
    first = [next(level for level, relief in enumerate(LEVELS) if name in relief.shed) for name in ORDER]
    assert first == sorted(set(first))


def test_nothing_is_shed_while_the_queue_empties_between_peaks() -> None:
    """A localization that takes 0.4 s now and then delays what waits behind it, and is no overload."""
    policy = LoadPolicy()
    for turn in range(2000):
        policy.note(0.4 if turn % 40 < 30 else 0.0, 0.9, turn * TURN_NS)
    assert policy.level == 0


def test_a_single_long_turn_is_no_overload() -> None:
    """When nodes join, their tables are computed, and what came meanwhile is worked off."""
    policy = LoadPolicy()
    now_ns = 0
    for delay_s in (0.0, 6.0, 0.5, 0.0, 0.0, 0.0):
        now_ns += 1_000_000_000
        policy.note(delay_s, 1.0, now_ns)
    assert policy.level == 0


def test_a_queue_that_does_not_empty_raises_the_level_until_the_last() -> None:
    policy = LoadPolicy()
    hold(policy, 60.0, BEHIND_S)
    assert policy.level == len(LEVELS) - 1


def test_a_long_queue_raises_the_level_faster() -> None:
    slow, fast = LoadPolicy(), LoadPolicy()
    hold(slow, 3.2, 0.15)
    hold(fast, 3.2, 1.0)
    assert 0 < slow.level < fast.level


def test_between_the_thresholds_the_level_stays() -> None:
    policy = LoadPolicy()
    now_ns = hold(policy, 3.2, 0.2)
    level = policy.level
    hold(policy, 100.0, (CALM_S + BEHIND_S) / 2, since_ns=now_ns)
    assert policy.level == level > 0


def test_idle_fusion_sheds_nothing_soon_after_the_load() -> None:
    policy = LoadPolicy()
    now_ns = hold(policy, 60.0, 1.0)
    hold(policy, len(LEVELS) * (IDLE_HOLD_NS + 2 * INTERVAL_NS) / 1e9, 0.0, busy=0.1, since_ns=now_ns)
    assert policy.level == 0


def test_a_level_that_was_needed_is_held_longer_the_next_time() -> None:
    policy = LoadPolicy(levels=2)
    now_ns, held_ns = 0, []
    for _ in range(8):
        now_ns = hold(policy, 2.1, 0.2, since_ns=now_ns)
        assert policy.level == 1
        began_ns = now_ns
        while policy.level:
            now_ns += TURN_NS
            policy.note(0.0, 0.9, now_ns)
        held_ns.append(now_ns - began_ns)
    assert held_ns == sorted(held_ns)
    assert held_ns[0] >= HOLD_NS
    assert 2 * HOLD_NS < held_ns[-1] <= LONGEST_HOLD_NS + 2 * INTERVAL_NS


@settings(max_examples=15, deadline=None)
@given(load=st.floats(1.1, 8.0), relief=st.floats(0.5, 0.8))
def test_a_load_that_shedding_can_carry_is_carried_without_flapping(load: float, relief: float) -> None:
    """Each level takes a share off the cost; the machine settles where the cost is less than the time."""
    machine = Machine(lambda level: load * relief**level)
    machine.run(600.0)
    settled = slice(len(machine.levels) // 2, None)
    if load * relief ** (len(LEVELS) - 1) < 1.0:
        in_time = sum(delay_s <= 0.5 for delay_s in machine.delays_s[settled])
        assert in_time >= 0.95 * len(machine.delays_s[settled])
        moves = sum(a != b for a, b in pairwise(machine.levels[settled]))
        assert moves <= 300.0 / 3.0  # at most a step in three seconds, in the second half of ten minutes
    machine.run(60.0, load=0.01)
    assert machine.levels[-1] == 0


# --- the clearest arrays


def clearest(powers: dict[str, float], background: float = 1e-6) -> Clearest:
    made = Clearest()
    for name, power in powers.items():
        made.note(name, background, active=False)
        made.note(name, power, active=True)
    return made


@given(
    powers=st.dictionaries(st.text("abc", min_size=1, max_size=4), st.floats(1e-5, 1.0), min_size=1, max_size=20),
    most=st.integers(1, 25),
)
def test_the_arrays_with_the_most_power_above_their_background_are_chosen(powers: dict[str, float], most: int) -> None:
    made = clearest(powers)
    joined = made.choose(most)
    assert set(joined) == made.chosen
    assert len(joined) == min(most, len(powers))
    weakest = min(powers[name] for name in joined)
    assert all(power <= weakest for name, power in powers.items() if name not in made.chosen)
    assert made.choose(most) == []  # the same again changes nothing


def test_a_loud_array_in_noise_is_less_clear_than_a_quiet_one_in_silence() -> None:
    made = Clearest()
    for name, background, power in (("noisy", 1e-2, 1e-1), ("calm", 1e-7, 1e-4)):
        made.note(name, background, active=False)
        made.note(name, power, active=True)
    assert made.choose(1) == ["calm"]


@pytest.mark.parametrize(("factor", "joins"), [(0.9 * JOIN_FACTOR, False), (1.1 * JOIN_FACTOR, True)])
def test_a_chosen_array_is_replaced_only_by_a_much_clearer_one(factor: float, joins: bool) -> None:
    made = clearest({"first": 1e-3})
    made.choose(1)
    made.note("second", 1e-6, active=False)
    made.note("second", factor * 1e-3, active=True)
    assert made.choose(1) == (["second"] if joins else [])
    assert len(made.chosen) == 1


def test_a_smaller_choice_keeps_the_clearest() -> None:
    made = clearest({name: 10.0**-k for k, name in enumerate("abcde")})
    made.choose(5)
    made.choose(2)
    assert made.chosen == {"a", "b"}
