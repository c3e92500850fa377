"""Alerts: `judge` applies the rules, `outbox` stores the alerts, and `delivery` sends them by the `actions`.

Nothing here is awaited by the fusion thread, and no module but `thread` starts one.
"""
