"""Alerts: rules are judged, what they raise is kept in an outbox, and actions deliver it.

Nothing here is awaited by the fusion thread, and no module but `service` starts a thread.
"""
