"""Finds what is wrong with a set-up from the sounds that it receives, and measures poses: pure numerics.

`findings` writes the findings of `livessl doctor` that come from delays; `channels`, `crosstalk` and `clocks` find
further faults in samples. Swapped channels and turned arrays are alternatives to the set-up as filed: `hypotheses`
lists them, `judge` compares them by sounds at unknown places, `trial` by sounds at known places, `diagnosis` chooses
one, and `findings` puts it into words. `resection` and `poses` measure poses from sounds at known places, `refine` from
sounds at unknown places. No file, socket or clock belongs here, nor code that changes live results.
"""
