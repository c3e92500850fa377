"""Recorded sound: files read as if a device delivered them, sessions on disk, and which file belongs to which array.

It knows no network and no audio interface.
"""
