"""Alerts: `judge` applies the rules, `outbox` keeps what they raise, and `courier` delivers it by the `actions`.

Nothing here is awaited by the fusion thread, and no module but `thread` starts one.
"""
