"""The sound of events: the arrays' recordings around them, and the beam at their place.

`ring` holds the newest frames, `cut` makes one recording of them, `record` writes it, and `service` is the thread that
does so. The beam itself is computed by `livessl.core.enhance`; nothing here locates anything.
"""

from __future__ import annotations
