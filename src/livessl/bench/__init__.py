"""How fast livessl is on the machine at hand: measured by running it."""
