"""The database of the history: its tables and their migrations, connections, searches, exports and heat map.

`livessl.server.store` is the door to it, and `livessl.server.event_retention` deletes what is too old. Only this
package knows SQLAlchemy and Alembic.
"""
