"""From one array's samples to generalized cross-correlations (GCC).

It knows no position and no other array.
"""
