"""After the warm-up nothing is left to compile: the first sounds on a machine do not wait for the compiler."""

from __future__ import annotations

import subprocess
import sys

import pytest

from livessl.core.kernels import kernels

SCRIPT = """
import numpy as np
from livessl.core.kernels import with_numba as compiled
from livessl.core.locate.estimator import Sound
from livessl.core.locate.onset import Onset
from livessl.core.geometry import Grid, posed, tetrahedron
from livessl.core.locate.peak_search import warm_up
from livessl.core.types import ArraySpec

def known():
    return {name: len(each.signatures) for name, each in vars(compiled).items() if hasattr(each, "signatures")}

warm_up()
before = known()
assert len(before) > 5, before
specs = [ArraySpec(n, posed(tetrahedron(0.5), p), (100.0, 6000.0)) for n, p in (("a", (1, 1, 1)), ("b", (3, 3, 1)))]
estimator = Onset(specs, Grid(((0.0, 4.0), (0.0, 5.0), (0.0, 3.0)), 0.2), 343.0)
samples = np.random.default_rng(1).standard_normal((4, 8000)).astype(np.float32)
samples.setflags(write=False)
sounds = {}
for spec in specs:
    front = estimator.onset_front_end(spec.name, 16000.0)
    onsets = [front.push(part, quiet=k < 4) for k, part in enumerate(np.split(samples, 10, axis=1))]
    sounds[spec.name] = Sound((samples,), 16000.0, onsets, sources=2)
found = estimator.locate(sounds)
estimator.power_maps(found.evidence)
assert known() == before, {name: count for name, count in known().items() if count != before[name]}
"""


@pytest.mark.skipif(kernels.NAME != "numba", reason="there is nothing to compile without numba")
def test_nothing_is_compiled_after_the_warm_up() -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=110, check=False)
    assert done.returncode == 0, done.stderr
