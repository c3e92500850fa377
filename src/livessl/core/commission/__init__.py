"""Finds what is wrong with a set-up from the sounds that it receives, and measures poses: pure numerics.

`findings` makes the findings of `livessl doctor` from delays, and `channels`, `crosstalk` and `clocks` make others from
samples; `resection` and `poses` measure where arrays are from sounds at known places, `refine` from sounds at unknown
places. No file, socket or clock belongs here, and nothing that changes what the live pipeline answers.
"""
