"""The fusion server: frames of many arrays become estimates, events and tracks for everyone who subscribed."""
