"""Benchmarks of the machine at hand: kernels, and a live server under load.

They run the real code and measure it; they contain no second implementation of anything.
"""
