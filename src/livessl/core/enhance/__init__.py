"""A clip of one sound, enhanced for a listener: a beam of each array at the place found, and all beams together."""

from __future__ import annotations
