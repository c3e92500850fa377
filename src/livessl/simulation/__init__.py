"""Simulated sound: a room by the image method, sources in it, and what microphones would record.

It knows no fusion and no server.
"""
