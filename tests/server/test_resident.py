"""A library that has done its work holds no memory, and works all the same when it is called again."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from livessl.core.kernels import kernels
from livessl.server.resident import _unchanged

MAPPINGS = """\
7f0000000000-7f0000003000 r--p 00000000 fe:00 11 /lib/libone.so
Rss: 12 kB
Private_Dirty: 0 kB
Anonymous: 0 kB
VmFlags: rd mr mw me
7f0000003000-7f0000009000 r-xp 00003000 fe:00 11 /lib/libone.so
Private_Dirty: 0 kB
Anonymous: 0 kB
VmFlags: rd ex mr mw me
7f0000009000-7f000000a000 r--p 00009000 fe:00 11 /lib/libone.so
Private_Dirty: 4 kB
Anonymous: 4 kB
VmFlags: rd mr mw me ac
7f000000a000-7f000000b000 r--p 0000a000 fe:00 11 /lib/libone.so
Private_Dirty: 0 kB
Anonymous: 4 kB
VmFlags: rd mr mw me ac
7f000000b000-7f000000c000 rw-p 0000b000 fe:00 11 /lib/libone.so
Private_Dirty: 0 kB
Anonymous: 0 kB
VmFlags: rd wr mr mw me ac
7f000000c000-7f000000d000 rw-p 00000000 00:00 0
Private_Dirty: 0 kB
Anonymous: 0 kB
VmFlags: rd wr mr mw me ac
7f000000d000-7f000000e000 r-xp 00000000 fe:00 12 /lib/libone.so.2
Private_Dirty: 0 kB
Anonymous: 0 kB
VmFlags: rd ex mr mw me
"""

SCRIPT = """
import sys
from pathlib import Path
import numba
from livessl.server.engine import COMPILER
from livessl.server.resident import unmap_unused

def held_kb():
    held, ours = 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if "-" in line.split()[0]:
            ours = line.endswith(COMPILER)
        elif ours and line.startswith("Rss:"):
            held += int(line.split()[1])
    return held

twice = numba.njit(lambda x: 2 * x)
assert twice(1) == 2
before = held_kb()
unmap_unused(COMPILER)
after = held_kb()
assert before > 20_000, before
assert after < 0.1 * before, (before, after)
assert twice(1.5) == 3.0  # compiled anew
assert held_kb() > after
"""


def test_only_what_is_as_in_the_file_is_given_back() -> None:
    assert _unchanged(MAPPINGS, "libone.so") == [(0x7F0000000000, 0x7F0000003000), (0x7F0000003000, 0x7F0000009000)]
    assert _unchanged(MAPPINGS, "libtwo.so") == []


@pytest.mark.skipif(
    kernels.NAME != "numba" or not Path("/proc/self/smaps").exists(), reason="needs numba, and Linux to look"
)
def test_the_compiler_holds_nothing_and_compiles_again() -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=110, check=False)
    assert done.returncode == 0, done.stderr
