"""Zones of a running server: who is inside, what is excluded, and the ones that operators draw.

`membership` computes who is inside, `presence` what a track does there, and `book` holds the zones that are in force.
Polygons are checked by `livessl.site.polygon`; nothing here raises an alert.
"""
