"""The HTTP interface: REST, WebSockets, metrics and documentation, and who may use them.

`app` puts the routes together, `auth` decides who may use them, and `encode` makes the JSON that `livessl.schema`
describes. It formats what the server holds and computes no estimate.
"""
