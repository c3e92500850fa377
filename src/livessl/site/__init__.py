"""The site file: models, reading, checks, secrets, and `build`, which makes core objects of it.

It opens no device and no socket.
"""
