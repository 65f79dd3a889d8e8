"""Observers: the set-membership observer, the filter, the hybrid of both, the smallest bounds that explain a log."""
