"""The search for the extreme directions of rows in windows of samples."""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import launcher

PI, TURN = math.pi, 2 * math.pi


@launcher
@no_type_check
def extreme_directions(angle, half, near, first, count):
    """The samples at which a row's direction, within its error, is the least and the greatest in each window.

    Angles are compared relative to the mean direction of the row in the window, as numbers in [-pi, pi).

    Args:
        angle: (N, B, m), directions of the rows at N samples [rad].
        half: (N, B, m), bounds on their errors [rad].
        near: (N, B, m), where the row may be active. Other samples do not count.
        first: (L, S), the first sample of each window.
        count: (L, S), its number of samples.

    Returns:
        The sample of the least and that of the greatest direction (L, S, B, m), -1 if no sample counts. The mean
        direction [rad].
    """
    (L, S), (_, B, m) = first.shape, angle.shape
    low, high = np.full((L, S, B, m), -1), np.full((L, S, B, m), -1)
    mean = np.zeros((L, S, B, m))
    cos, sin = np.cos(angle), np.sin(angle)
    for w in range(L):
        for s in range(S):
            start, end = first[w, s], first[w, s] + count[w, s]
            for k in range(B):
                for j in range(m):
                    x = y = 0.0
                    begin = -1
                    for i in range(start, end):
                        if near[i, k, j]:
                            x, y = x + cos[i, k, j], y + sin[i, k, j]
                            begin = i if begin < 0 else begin
                    if begin < 0:
                        continue
                    mean[w, s, k, j] = reference = math.atan2(y, x)
                    least, greatest = np.inf, -np.inf
                    for i in range(begin, end):
                        if near[i, k, j]:
                            ahead = (angle[i, k, j] - reference + PI) % TURN - PI
                            if ahead - half[i, k, j] < least:
                                least, low[w, s, k, j] = ahead - half[i, k, j], i
                            if ahead + half[i, k, j] > greatest:
                                greatest, high[w, s, k, j] = ahead + half[i, k, j], i
    return low, high, mean
