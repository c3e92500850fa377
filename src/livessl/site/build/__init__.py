"""Core objects made from a site: the one place where configuration becomes arrays, grids, pipelines and fusions.

The models of the site file do not depend on it.
"""
