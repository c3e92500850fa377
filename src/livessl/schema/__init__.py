"""The contract of the API: Pydantic models of every message and answer, which server and clients share.

It may know the names of the core's states and nothing else, so that a client can load it quickly.
"""
