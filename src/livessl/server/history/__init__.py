"""The database of the history: its tables and their migrations, connections, searches, exports and heat map.

`livessl.server.store` is the door to it. Only this package knows SQLAlchemy and Alembic.
"""
