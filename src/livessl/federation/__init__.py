"""The hub: one API, history and page for many sites, whose servers send their results through NATS JetStream.

`livessl.server.forwarding` is the sites' side.
"""
