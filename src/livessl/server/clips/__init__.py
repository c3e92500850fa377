"""The sound of events: the arrays' recordings around them, and the enhanced signal of their beams at the event's place.

`ring` holds the newest frames, and `waiting` the events whose clip is still to be made. `cut` makes one recording of
frames, `record` makes and writes a clip, and `service` runs all this in a thread and decides how long clips are kept.
`speech` looks for speech before a clip is written, in the process `speech_main`. `folder` stores and deletes clips,
with `erase`, `reader`, and `index`, whose `by_room` gives the order in which clips are deleted when space runs out.
`outcomes` and `missing` know what has become of events, and `trouble` what keeps clips from being written.
`livessl.core.enhance` computes the enhanced signal. `relocate` and `relocate_many` locate events again from what
`stored_sound` reads, and `listeners` passes on live sound. Nothing here decides what an event is or where it was.
"""

from __future__ import annotations
