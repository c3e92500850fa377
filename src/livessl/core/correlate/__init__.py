"""Generalized cross-correlations (GCC) of the samples of one array.

Nothing here knows a position or another array.
"""
