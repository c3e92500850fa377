"""Locates sources: a position, its covariance and its confidence from the correlations of several arrays.

`onset` is the default method and calls the others: `srp` and `peak_search` find the peak of the summed maps, `outliers`
finds the arrays that disagree, `confidence` judges the position, and `second_source` and `outside` look for what else
explains the sound. `srp_phat` is the paper's method. Nothing here keeps state between sounds.
"""
