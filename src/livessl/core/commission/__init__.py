"""Finds what is wrong with a set-up from the sounds that it receives, and measures poses: pure numerics.

No file, socket or clock belongs here, and nothing that changes what the live pipeline answers.
"""
