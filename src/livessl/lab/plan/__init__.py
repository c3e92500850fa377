"""Design of an installation before it is built: expected errors, coverage, and advice on where to move arrays.

It knows geometry and room acoustics; it never reads a recording.
"""
