"""Generalized cross-correlations (GCC) of the samples of one array.

`gcc_phat` correlates a segment, as in the paper; `onset_gcc` correlates frames by their onsets, as the default method
does. Nothing here knows a position or another array.
"""
