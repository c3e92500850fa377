"""Zones of a running server: who is inside, what is excluded, and the ones that operators draw."""
