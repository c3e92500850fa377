"""Capture nodes: an audio device becomes frames on the wire, kept until the server has stored what came of them.

Nothing here locates anything.
"""
