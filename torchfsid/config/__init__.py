"""YAML files as validated, frozen records, and the objects of the package that they stand for. No torch before
something is built.
"""
