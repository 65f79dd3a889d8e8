"""Sizes of sets and errors of estimates, all as lengths.

The lengths of a set are its diameter and the square root of its area. That of an estimate is its distance to the goal.
"""

from __future__ import annotations

import math

import numpy as np

from experiments.runs.saved import Results


def lengths(results: Results) -> dict[str, np.ndarray]:
    """All lengths by name: (times, robots) [m]."""
    measures = {"ukf": results.error("ukf_0", "ukf_1"), "hybrid": results.error("hybrid_0", "hybrid_1")}
    for kind in results.config.sets:
        measures[f"{kind} sqrt_area"] = np.sqrt(results.of_set(kind, "volume"))
        measures[f"{kind} diameter"] = results.of_set(kind, "diameter")
        for point in ("centroid", "centre"):
            estimate = results.of_set(kind, f"{point}_0", f"{point}_1")
            measures[f"{kind} {point}"] = np.linalg.norm(estimate - results.goals, axis=-1)
    return measures


def prior_lengths(results: Results) -> dict[str, np.ndarray]:
    """The same lengths before the first measurement: (robots,) [m]."""
    lower, upper = np.array(results.config.prior.lower), np.array(results.config.prior.upper)
    distance = np.linalg.norm((lower + upper) / 2 - results.goals, axis=-1)
    regions = {"sqrt_area": math.sqrt(np.prod(upper - lower)), "diameter": float(np.linalg.norm(upper - lower))}
    before = {"ukf": distance, "hybrid": distance}
    for kind in results.config.sets:
        before |= {f"{kind} {name}": np.full_like(distance, length) for name, length in regions.items()}
        before |= {f"{kind} centroid": distance, f"{kind} centre": distance}
    return before
