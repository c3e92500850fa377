"""The sound of events: the arrays' recordings around them, and the beam at their place.

`ring` holds the newest frames, `waiting` the events, `cut` makes one recording of frames, `record` makes and writes a
clip, and `service` is the thread that does so and decides how long clips are kept. `speech` looks for speech before a
clip is written, in the process `speech_main`. `folder` stores and deletes clips, with `erase` and `index`, whose
`by_room` is the order in which clips make room; `outcomes` and `missing` know what has become of events.
`livessl.core.enhance` computes the beam, and `relocate` locates an event again from its recordings.
"""

from __future__ import annotations
