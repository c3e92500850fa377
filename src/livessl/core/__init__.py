"""The pure core: NumPy arrays in, NumPy arrays out.

It contains no sockets, clocks, files, threads, logging or configuration.
"""
