"""Migrations of the history's database, oldest first; the server applies those that a database lacks at its start."""

from typing import Final

BATCH: Final = 2000
"""Events that a migration reads and writes at a time."""
