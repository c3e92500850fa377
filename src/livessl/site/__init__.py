"""The site file: its models, reading, checks, keys and tokens, and `build`, which makes core objects from it.

`models` checks single values and `checks` what several sections say together; defaults of what localizes stand in
`core.stream.parameters`. This package opens no device and no socket.
"""
