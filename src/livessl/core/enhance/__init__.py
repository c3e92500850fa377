"""Enhances the sound of one event for listeners: a beam of each array at the place found, and all beams together."""

from __future__ import annotations
