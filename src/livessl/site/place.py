"""Places in YAML files, and findings there."""

from __future__ import annotations

Place = tuple[str | int, ...]
"""Place in a file: keys and indices from the top down."""

Finding = tuple[Place, str]
"""A place in a file and the fault there, in one sentence."""
