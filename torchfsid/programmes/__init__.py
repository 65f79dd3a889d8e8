"""Two convex programmes over half-spaces: nearest point and inscribed ball. This package holds the exact solver with
its derivatives, the layers, and the cvxpylayers backend.
"""
