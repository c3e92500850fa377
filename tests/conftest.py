"""What all tests share."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from inspect import signature

import httpx
import pytest
from hypothesis import settings
from threadpoolctl import threadpool_limits

from livessl.core.locate.peak_search import warm_up
from livessl.core.methods import METHODS
from livessl.core.stream.load_policy import LoadPolicy
from livessl.garbage import collect_as_usual

pytest_plugins = ["api_contract", "history_places"]

# As in every command: matrix products are small here, and a second BLAS thread would wait in a loop, which costs forty
# times the processor time of a product.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # for a library that is loaded later
threadpool_limits(limits=1, user_api="blas")  # for one that is loaded

# A busy machine may need more than the 5 s that httpx gives a request by default; only a hang reaches this.
usual = signature(httpx.get).parameters["timeout"].default
usual.connect = usual.read = usual.write = usual.pool = 100.0

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in a shell's background: children would ignore it, too
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A busy machine is no fault of the code. With chance in the examples, a change could fail for an old fault.
# The examples are the same each time, so few are tried here; `search` tries new ones.
settings.register_profile("livessl", deadline=None, derandomize=True, max_examples=20)
settings.register_profile("search", deadline=None, print_blob=True)
settings.load_profile("livessl")


@pytest.fixture(autouse=True, scope="session")
def _compiled() -> None:
    """No test's patience is spent on the compiler."""
    warm_up()


@pytest.fixture(autouse=True)
def _methods() -> Iterator[None]:
    """A method that a test has registered is there for that test only."""
    before = dict(METHODS)
    yield
    METHODS.clear()
    METHODS.update(before)


@pytest.fixture(scope="module")
def nothing_is_shed() -> Iterator[None]:
    """Servers shed nothing, however busy the machine is."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LoadPolicy, "note", lambda *_: 0)
        yield


LONGEST_FIRST = (
    "test_processes.py",
    "test_live.py",
    "test_recorded_files.py",
    "test_release.py",
    "test_api_fuzz.py",
    "test_unchanged.py",
    "test_install.py",
    "test_real_recordings.py",
    "test_soak.py",
    "test_examples.py",
    "test_tutorial.py",
    "test_replayed_faults.py",
    "test_sessions.py",
    "test_localizer.py",
    "test_campaign.py",
    "test_clocks_and_backfill.py",
    "test_overloaded_server.py",
    "test_killed_alerts.py",
    "test_hub.py",
    "test_calibrate_benchmark.py",
    "test_noise.py",
    "test_clips_of_a_process.py",
    "test_accessibility.py",
    "test_reverse_proxy.py",
    "test_documentation.py",
    "test_dashboard.py",
    "test_clips_panel.py",
    "test_set_up_view.py",
    "test_relocate_command.py",
    "test_contributing.py",
)
"""Files that take minutes: begun first, no worker is left with one of them when the others are done."""


@pytest.hookimpl(trylast=True)  # after the shuffling
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(
        key=lambda item: LONGEST_FIRST.index(item.path.name) if item.path.name in LONGEST_FIRST else len(LONGEST_FIRST)
    )


def pytest_collection_finish() -> None:
    collect_as_usual()  # the tests themselves stay


def require(condition: bool, reason: str) -> None:
    """Skip the test unless `condition` holds; fail it instead where LIVESSL_REQUIRE_ALL is 1.

    For programs and libraries that a complete machine has: CI sets the variable, so that nothing is skipped unseen.
    """
    if condition:
        return
    if os.environ.get("LIVESSL_REQUIRE_ALL") == "1":
        pytest.fail(f"LIVESSL_REQUIRE_ALL is set, but {reason}")
    pytest.skip(reason)
