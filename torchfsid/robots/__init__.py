"""What a robot does, the forward model: what is measured of it and how wrong that may be, its task, its barriers, its
controller, the closed loop.
"""
