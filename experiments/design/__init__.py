"""Designs by gradient: where to put a probing obstacle, and how to weigh measurements."""
