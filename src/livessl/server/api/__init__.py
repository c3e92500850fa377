"""The HTTP interface: REST, WebSockets, metrics and documentation, and who may use them.

It formats what the server holds and computes no estimate.
"""
