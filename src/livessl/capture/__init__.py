"""Capture nodes: blocks of an audio device become frames on the wire, kept until the server needs them no more.

`sound_device` delivers blocks from a process of its own (`device_main`, `portaudio`), `node` turns them into frames by
`core.stream.pipeline`, `spool` keeps the frames, and `outbox` and `link` send them. Nothing here locates anything.
"""
