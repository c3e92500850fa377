"""The streaming part of the core: frames that arrive late or out of order become events and tracks.

All state that is kept over time is here. Time is an argument; no module reads a clock.
"""
