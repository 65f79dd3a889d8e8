"""The searches, in scalar code compiled by numba. They take and return numpy arrays and need no torch. An `item`
function handles one item, a `launcher` loops over the items of a batch.
"""
