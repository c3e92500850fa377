"""Virtual audio interfaces for tests; where they cannot be made, the tests are skipped."""

from __future__ import annotations

from pathlib import Path

from conftest import require
from livessl.lab import virtual_interface
from livessl.lab.virtual_interface import COUNTED, Interface, counts_of

__all__ = ["COUNTED", "Interface", "Interfaces", "counts_of"]


class Interfaces(virtual_interface.Interfaces):
    """The interfaces of a machine."""

    def __init__(self, folder: Path) -> None:
        lack = virtual_interface.missing()
        require(lack is None, str(lack))
        super().__init__(folder)
