"""The fusion server: frames of many arrays become events, tracks and maps for everyone who subscribed.

`app` is the one list of what runs; nothing here knows an audio device.
"""
