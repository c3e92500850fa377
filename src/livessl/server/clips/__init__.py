"""What is kept of an event's sound: the arrays' recordings around it, and the beam at its place."""

from __future__ import annotations
