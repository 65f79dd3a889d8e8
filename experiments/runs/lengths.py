"""Sizes of sets and errors of estimates, all as lengths.

The lengths of a set are its diameter and the square root of its area, in space the cube root of its volume. That of an
estimate is its distance to the goal.
"""

from __future__ import annotations

import numpy as np

from experiments.runs.saved import Results

ROOT_NAMES = {2: "sqrt_area", 3: "cbrt_volume"}
"""Names of the length of a set's volume, by dimension."""

ROOTS = {2: np.sqrt, 3: np.cbrt}


def lengths(results: Results) -> dict[str, np.ndarray]:
    """All lengths by name: (times, robots) [m]."""
    n = results.config.dimension
    measures = {of: results.error(*(f"{of}_{i}" for i in range(n))) for of in ("ukf", "hybrid")}
    for kind in results.config.sets:
        measures[f"{kind} {ROOT_NAMES[n]}"] = ROOTS[n](results.of_set(kind, "volume"))
        measures[f"{kind} diameter"] = results.of_set(kind, "diameter")
        for point in ("centroid", "centre"):
            estimate = results.of_set(kind, *(f"{point}_{i}" for i in range(n)))
            measures[f"{kind} {point}"] = np.linalg.norm(estimate - results.goals, axis=-1)
    return measures


def prior_lengths(results: Results) -> dict[str, np.ndarray]:
    """The same lengths before the first measurement: (robots,) [m]."""
    lower, upper = np.array(results.config.prior.lower), np.array(results.config.prior.upper)
    distance = np.linalg.norm((lower + upper) / 2 - results.goals, axis=-1)
    n = len(lower)
    regions = {ROOT_NAMES[n]: float(ROOTS[n](np.prod(upper - lower))), "diameter": float(np.linalg.norm(upper - lower))}
    before = {"ukf": distance, "hybrid": distance}
    for kind in results.config.sets:
        before |= {f"{kind} {name}": np.full_like(distance, length) for name, length in regions.items()}
        before |= {f"{kind} centroid": distance, f"{kind} centre": distance}
    return before
