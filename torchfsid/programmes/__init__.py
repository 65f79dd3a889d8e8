"""Two convex programmes over half-spaces, nearest point and inscribed ball: the exact solver with its derivatives, the
layers, the cvxpylayers backend.
"""
