"""The fusion server: frames of many arrays become events, tracks and maps for everyone who subscribed.

Messages of nodes come through `receiver` and `ingest` to `engine`, which steps `core.stream`. Its results go through
`publisher` and `event_log` to `fanout` (live clients), `store` (the history) and `sinks`. `assembly` is the one list of
what runs; nothing here knows an audio device.
"""
