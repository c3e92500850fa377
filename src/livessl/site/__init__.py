"""The site file: its models, reading, checks, keys and tokens, and `build`, which makes core objects from it.

This package opens no device and no socket.
"""
