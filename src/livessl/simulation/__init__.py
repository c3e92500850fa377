"""Simulated sound: a room by the image method, sources in it, and what microphones would record.

`room` has the image method, `scene` puts sounds into a room, and `export` writes a session. It knows no fusion and no
server.
"""
