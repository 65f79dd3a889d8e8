"""Configuration files in YAML: validated, frozen records that build the objects of the package.

PyTorch is imported only when something is built.
"""
