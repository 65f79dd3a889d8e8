"""Covariances that have lost definiteness by round-off."""

from __future__ import annotations

import numpy as np

from torchfsid.observers.motions import Array

FLOOR = 1e-8
"""Noises per step are at least this fraction of the position noise (x) and of the prior's spread (theta)."""

DEFINITE = 1e-13
"""A repaired covariance's smallest eigenvalue over its largest: a little more than a Cholesky factorisation needs."""


def make_definite(covariance: Array, scale: Array) -> tuple[Array, bool]:
    """The symmetric part, with eigenvalues raised (in units of `scale`) if not definite, and whether they were."""
    symmetric = (covariance + covariance.T) / 2
    try:
        np.linalg.cholesky(symmetric)
    except np.linalg.LinAlgError:
        values, axes = np.linalg.eigh(symmetric / np.outer(scale, scale))
        axes = axes * scale[:, None]
        floor = max(DEFINITE * np.abs(values).max(), FLOOR**2)
        raised = (axes * values.clip(min=floor)) @ axes.T
        return (raised + raised.T) / 2, True
    return symmetric, False
