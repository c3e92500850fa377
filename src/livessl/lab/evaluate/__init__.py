"""Campaigns of simulated rooms: the paper's experiments and the localizer's own, with results, claims and figures.

`paper` has the paper's experiments as data and `localizer` those of this project; `campaign` runs either. They call the
pipeline as users do; no parameter of the pipeline is set here.
"""
