"""Compiled code is kept on the disk, and runs where nothing can be kept."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numba
import pytest

SOURCE = """
import numba
from livessl.core.kernels.jit import jit

def twice(x):
    return 2 * x

ours = jit()(twice)
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    path = tmp_path / "of_its_own.py"
    path.write_text(SOURCE, encoding="utf-8")
    spec = importlib.util.spec_from_file_location("of_its_own", path)
    assert spec is not None
    assert spec.loader is not None
    return importlib.util.module_from_spec(spec)


def run(module: ModuleType) -> None:
    assert module.__spec__ is not None
    assert module.__spec__.loader is not None
    module.__spec__.loader.exec_module(module)


def test_machine_code_is_kept(module: ModuleType, tmp_path: Path) -> None:
    run(module)
    assert module.ours(21) == 42
    assert list((tmp_path / "__pycache__").glob("*.nbi")) != []


def test_where_nothing_can_be_kept_it_compiles_anew(
    module: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files stand where folders would be made, which stops root too."""
    for name in ("__pycache__", "cache"):
        (tmp_path / name).touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    run(module)
    with pytest.raises(RuntimeError, match="cannot cache"):
        numba.njit(cache=True)(module.twice)
    assert module.ours(21) == 42
