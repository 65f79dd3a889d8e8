"""Sets of parameters: batched polygons and polytopes, and the feasible set Theta(t) that is made of them. The sets are
cut, merged and differentiated here.
"""
