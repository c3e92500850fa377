"""Locates sources: a position, its covariance and its confidence from the correlations of several arrays.

Nothing here keeps state between sounds.
"""
