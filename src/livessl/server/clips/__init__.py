"""The sound of events: the arrays' recordings around them, and the beam at their place.

`ring` holds the newest frames, `cut` makes one recording of them, `record` writes it, and `service` is the thread that
does so and decides how long clips are kept. `folder` stores and deletes them. `livessl.core.enhance` computes the beam,
and `relocate` locates an event again from its recordings.
"""

from __future__ import annotations
