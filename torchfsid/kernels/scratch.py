"""Places for the work on one polyhedron of F facets that is cut by R rows.

On the CPU they are arrays of their own. On a GPU they are parts of few large arrays, with an entry for each thread.
"""

from __future__ import annotations

from typing import Any, NamedTuple, no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, launcher
from torchfsid.kernels.cutting import Marks, marks_of
from torchfsid.kernels.roofs import Roof, roof_of
from torchfsid.kernels.simple_polyhedron import Graph, graph_of
from torchfsid.kernels.solid import Frame, frame_of


class Scratch(NamedTuple):
    """Lines are first the facets, then the rows.

    Attributes:
        tolerance: for each row the round-off of a.z - c.
        depth: how far each row cuts into the polyhedron.
        cutting: the rows that cut.
        box: the bounding box.
        lines: the lines (a, c).
        proof: the lines that contradict each other.
        far: the reach.
        centre: the centroid.
        edges: an end of an edge for each pair of facets (all -1).
        at: a vertex of each line.
        graph: the polyhedron.
        spare: new vertices.
        marks: for cuts.
        frame: for merging.
        roof: for merging.
    """

    tolerance: Any
    depth: Any
    cutting: Any
    box: Any
    lines: Any
    proof: Any
    far: Any
    centre: Any
    edges: Any
    at: Any
    graph: Graph
    spare: Graph
    marks: Marks
    frame: Frame
    roof: Roof


@launcher
@no_type_check
def scratch_of(F, R):
    L = F + R
    return Scratch(
        np.empty(R), np.empty(R), np.empty(R, np.int64), np.empty((3, 2)), np.empty((L, 4)), np.full(4, -1),
        np.empty(3), np.empty(3), np.full((F, F), -1), np.full(L, -1), graph_of(2 * L), graph_of(2 * L),
        marks_of(2 * L, L), frame_of(2 * L), roof_of(L),
    )  # fmt: skip


def places(F: int, R: int) -> list[tuple[tuple[int, ...], type]]:
    """The shape and the type of a thread's entry in each of the arrays `work` of `entry`."""
    L = F + R
    return [
        ((9 * L, 3), np.float64), ((10 * L, 3), np.int32), ((5 * L + 2 * R,), np.float64), ((13 * L + R,), np.int32),
        ((2 * L, 5), np.float64), ((F, F), np.int32),
    ]  # fmt: skip


@item
@no_type_check
def entry(work, t, F, R, small):
    """The `Scratch` of thread t in the arrays `work`, for which there are `places`. A launcher for the CPU cannot call
    it: references to its parts are not counted.

    `small` are arrays of the thread: box (3, 2), proof (4,), far (3,), centre (3,), small systems (6, 3, 3), and middle
    (3,), axes (3, 3) and scale (3,) of the frame.
    """
    points, meets, reals, numbers, lines, edges = work
    box, proof, far, centre, systems, middle, axes, scale = small
    L = F + R
    for f in range(F):
        for g in range(F):
            edges[t, f, g] = -1
    for e in range(L):
        numbers[t, e] = -1  # `half`
    graph = Graph(points[t, : 2 * L], meets[t, : 2 * L], meets[t, 2 * L : 4 * L])
    spare = Graph(points[t, 2 * L : 4 * L], meets[t, 4 * L : 6 * L], meets[t, 6 * L : 8 * L])
    frame = Frame(points[t, 4 * L : 6 * L], middle, axes, scale)
    marks = Marks(
        reals[t, : 2 * L], numbers[t, L : 3 * L], numbers[t, 3 * L : 5 * L], numbers[t, 5 * L : 7 * L],
        numbers[t, :L], systems,
    )  # fmt: skip
    roof = Roof(
        lines[t, L:], reals[t, 2 * L : 3 * L], reals[t, 3 * L : 4 * L], numbers[t, 7 * L : 8 * L],
        numbers[t, 8 * L : 9 * L], numbers[t, 9 * L : 10 * L], numbers[t, 10 * L : 11 * L], points[t, 6 * L : 7 * L],
        numbers[t, 11 * L : 12 * L], points[t, 7 * L : 8 * L], reals[t, 4 * L : 5 * L], points[t, 8 * L :],
        meets[t, 8 * L : 9 * L], meets[t, 9 * L :],
    )  # fmt: skip
    return Scratch(
        reals[t, 5 * L : 5 * L + R], reals[t, 5 * L + R :], numbers[t, 13 * L :], box, lines[t, :L], proof, far,
        centre, edges[t], numbers[t, 12 * L : 13 * L], graph, spare, marks, frame, roof,
    )  # fmt: skip
