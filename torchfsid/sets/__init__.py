"""Sets of parameters: batched polygons and polytopes, how they are cut, merged and differentiated, and the feasible set
Theta(t) made of them.
"""
