"""The layout of a site: its distances, its expected errors, and drawings of it for a terminal and as a figure.

It knows the site file only; it never reads a recording.
"""
