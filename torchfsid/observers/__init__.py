"""What is known over time: the set-membership observer, the filter, the hybrid of both, and how large the errors of a
log must be.
"""
