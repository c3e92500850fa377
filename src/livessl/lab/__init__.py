"""Experiments and design tools on top of everything: the paper's experiments, planning, benchmarks, the demo.

Only the command line imports them; nothing that runs in a deployment depends on this package.
"""
