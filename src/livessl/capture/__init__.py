"""Capture nodes: blocks of an audio device become frames on the wire, kept until the server needs them no more.

Nothing in this package locates anything.
"""
