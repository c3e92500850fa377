"""From frames as they arrive, late or out of order, to events and tracks: everything that keeps state over time.

Time is an argument; nothing here reads a clock.
"""
