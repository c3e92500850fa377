"""Print every event that a server publishes, and subscribe again when the connection is lost.

    python examples/subscribe.py [URL]

The URL is that of the server, http://127.0.0.1:8000 by default; `livessl demo` starts one there.
"""

import json
import sys
import time

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

server = sys.argv[1] if len(sys.argv) > 1 else "http://127.0.0.1:8000"
live = f"{server.replace('http', 'ws', 1)}/api/v1/live?kinds=event"
last_seq = None

while True:
    try:
        # since_seq makes the server repeat what was missed while the connection was lost
        with connect(live if last_seq is None else f"{live}&since_seq={last_seq}") as connection:
            for text in connection:
                message = json.loads(text)
                last_seq = message["seq"]
                if message["kind"] == "event":
                    print(message["time_utc"], message["status"], message["position_m"], flush=True)
    except (OSError, ConnectionClosed):
        print("connection lost; trying again in 1 s", file=sys.stderr, flush=True)
        time.sleep(1.0)
