"""The hub: one API, history and page for many sites, whose servers send their results through NATS JetStream.

`intake` reads what sites send, `archive` stores it, and `routes` answers. `livessl.server.forwarding` is the sites'
side; nothing here locates anything.
"""
