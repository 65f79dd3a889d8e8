"""What a motion says, the inverse model: the active set, the KKT conditions, and the half-spaces of theta that follow
from one measurement.
"""
