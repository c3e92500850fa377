"""Capture nodes: audio devices become frames on the wire."""
