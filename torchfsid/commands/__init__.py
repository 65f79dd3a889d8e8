"""What the command line does: observe a log, check it, compare hypotheses, and the results folder and figures they
leave.
"""
