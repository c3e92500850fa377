"""Simulated sound: a room by the image method, sources in it, and what the arrays would record."""
