"""Campaigns of simulated rooms: the paper's experiments and the localizer's own, with results, claims and figures.

They call the pipeline as users do; no parameter of the pipeline is set here.
"""
