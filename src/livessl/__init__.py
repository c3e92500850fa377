"""livessl tells, live, where in a room a sound happened."""

__version__ = "0.1.0"
