"""The paper's experiments, from a YAML file to results and figures: `python -m experiments run CONFIG --out DIR`.

A run validates everything, simulates, observes and writes its results. Figures are drawn last, from the written files.
`python -m experiments figures DIR` draws the same figures again.
"""
