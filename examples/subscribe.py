"""Print every event that a server publishes. The client connects again by itself, and misses nothing meanwhile.

    python examples/subscribe.py [URL]

The URL is that of the server, http://127.0.0.1:8000 by default; `livessl demo` starts one there.
"""

import sys

from livessl import client

server = sys.argv[1] if len(sys.argv) > 1 else "http://127.0.0.1:8000"

with client.connect(server, kinds=["event"]) as live:
    for event in live:
        if isinstance(event, client.Event):
            time = "-" if event.time_utc is None else event.time_utc.isoformat()
            print(time, event.status, event.position_m, flush=True)
