"""The searches, in scalar code compiled by numba: numpy in, numpy out, no torch. A function handles one item; launchers
loop over items.
"""
