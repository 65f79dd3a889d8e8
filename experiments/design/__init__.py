"""Observers designed by gradient: where to put a probing obstacle, and how to weigh what is measured."""
