"""Core objects made of a site: the one place where configuration becomes grids, pipelines and fusions.

The models and checks of a site do not depend on it.
"""
