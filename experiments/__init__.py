"""The paper's experiments, from a YAML file to results and figures: `python -m experiments run CONFIG --out DIR`.

A run validates everything, simulates, observes, writes its results, and only then draws, from the files it wrote:
`python -m experiments figures DIR` draws the same figures again.
"""
