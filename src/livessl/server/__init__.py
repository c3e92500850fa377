"""The fusion server: frames of many arrays become events, tracks and maps for everyone who subscribed.

Messages of nodes come through `receiver` and `ingest` to `engine`, which steps `core.stream`. Its results go through
`publisher` and `event_log` to `fanout` (live clients), `store` (the history) and `sinks`. Of the packages, `history` is
the database, `api` is HTTP and WebSockets, `alerts` judges and delivers, `zones` and `clips` are parts of the room and
the sound of events, and `forwarding` leads to a hub. `assembly` alone creates the parts, and `app` starts them. Nothing
here may import `livessl.capture`, which reads audio devices.
"""
