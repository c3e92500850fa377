"""The sound of events: the arrays' recordings around them, and the beam at their place."""

from __future__ import annotations
