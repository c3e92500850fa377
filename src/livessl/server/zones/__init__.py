"""Zones of a running server: which of them hold a position, what a track does there, and those that operators draw.

`zone_map` answers for all zones at one moment, with the probabilities that `membership` computes. `presence` follows
tracks, and `book` holds the zones that are in force. Polygons are checked by `livessl.site.polygon`; nothing here
raises an alert.
"""
