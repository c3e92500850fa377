"""The streaming part of the core: frames that arrive late or out of order become events and tracks.

On a node, `pipeline` cuts blocks into frames (`timeline`), takes hum and rumble out (`steady_background`), and decides
which frames are sent (`activity`, `segmenter`). In the server, `fusion` is the only entry: `alignment` joins the frames
of all arrays and handles late ones, `pending_event` is the life of an event, `backfill` requests missing frames,
`verdict` makes results, and `tracker` joins results to tracks.
`final_pass` does all this a second time, for the results that stay.

All state that is kept over time is here. Time is an argument; no module reads a clock.
"""
