"""From the correlations of several arrays to a position, its covariance and its confidence.

It sees one sound at a time and keeps no state between sounds.
"""
