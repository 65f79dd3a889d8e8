"""Updates of one set {z : A z <= b} in the plane by other libraries.

Each peer is a class. `start(A, b)` begins with irredundant rows. `update(A, b)` intersects, drops redundant rows and
returns (area, vertices, Chebyshev centre). Peers are used as their manuals say, with default tolerances. pycddlib and
pypoman are GPL. They are only run here, never imported by the package.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec

import numpy as np

Answer = tuple[float, np.ndarray, np.ndarray]
BOX = np.array([[-1.0, 0], [1, 0], [0, -1], [0, 1]]), np.full(4, 10.0)


def _hull(points: np.ndarray) -> tuple[np.ndarray, float]:
    """The points of a convex polygon in order, and its area."""
    spokes = points - points.mean(0)
    ring = points[np.argsort(np.arctan2(spokes[:, 1], spokes[:, 0]))]
    x, y = (ring - ring[0]).T
    return ring, float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2


class Shapely:
    """Shapely: half-planes are large boxes.

    The centre is that of GEOS's inscribed circle, with its default tolerance (size/1000).
    """

    packages = ("shapely",)

    def start(self, A: np.ndarray, b: np.ndarray) -> None:
        import shapely

        self.shape, self.lib = shapely.box(-10, -10, 10, 10), shapely
        self._cut(A, b)

    def _cut(self, A: np.ndarray, b: np.ndarray) -> None:
        for a, c in zip(A, b, strict=True):
            n = a / np.linalg.norm(a)
            foot, along = n * c / np.linalg.norm(a), 100 * np.array([-n[1], n[0]])
            plane = self.lib.Polygon([foot + along, foot + along - 100 * n, foot - along - 100 * n, foot - along])
            self.shape = self.shape.intersection(plane)

    def update(self, A: np.ndarray, b: np.ndarray) -> Answer:
        self._cut(A, b)
        circle = self.lib.maximum_inscribed_circle(self.shape)
        return self.shape.area, np.array(self.shape.exterior.coords)[:-1], np.array(circle.coords[0])


class Scipy:
    """SciPy: the Chebyshev centre by HiGHS, vertices and redundant rows by Qhull about it."""

    packages = ("scipy",)

    def start(self, A: np.ndarray, b: np.ndarray) -> None:
        self.A, self.b = A, b

    def update(self, A: np.ndarray, b: np.ndarray) -> Answer:
        from scipy.optimize import linprog
        from scipy.spatial import ConvexHull, HalfspaceIntersection

        A, b = np.vstack([self.A, A]), np.append(self.b, b)
        norms = np.linalg.norm(A, axis=1, keepdims=True)
        best = linprog([0, 0, -1], A_ub=np.hstack([A, norms]), b_ub=b, bounds=[(None, None)] * 2 + [(0, None)])
        found = HalfspaceIntersection(np.column_stack([A, -b]), best.x[:2])
        self.A, self.b = A[found.dual_vertices], b[found.dual_vertices]
        hull = ConvexHull(found.intersections)
        return hull.volume, found.intersections[hull.vertices], best.x[:2]


class Cdd:
    """pycddlib: redundancy, double description and the linear programme of cddlib, in floats."""

    packages = ("pycddlib-standalone",)

    def start(self, A: np.ndarray, b: np.ndarray) -> None:
        self.A, self.b = A, b

    def update(self, A: np.ndarray, b: np.ndarray) -> Answer:
        import cdd

        A, b = np.vstack([self.A, A]), np.append(self.b, b)
        matrix = cdd.matrix_from_array(np.column_stack([b, -A]), rep_type=cdd.RepType.INEQUALITY)
        cdd.matrix_canonicalize(matrix)
        rows = np.array(matrix.array)
        self.A, self.b = -rows[:, 1:], rows[:, 0]
        points = np.array(cdd.copy_generators(cdd.polyhedron_from_matrix(matrix)).array)[:, 1:]
        norms = np.linalg.norm(self.A, axis=1)
        table = np.vstack([np.column_stack([self.b, -self.A, -norms]), [0.0, 0.0, 0.0, 1.0]])
        programme = cdd.linprog_from_array(table, cdd.LPObjType.MAX)
        cdd.linprog_solve(programme)
        ring, area = _hull(points)
        return area, ring, np.array(programme.primal_solution[:2])


class Pypoman:
    """pypoman: vertices (by cddlib) and Chebyshev centre (by its linear programme). Rows follow from the vertices."""

    packages = ("pypoman",)

    def start(self, A: np.ndarray, b: np.ndarray) -> None:
        self.A, self.b = A, b

    def update(self, A: np.ndarray, b: np.ndarray) -> Answer:
        import pypoman

        A, b = np.vstack([self.A, A]), np.append(self.b, b)
        points = np.array(pypoman.compute_polytope_vertices(A, b))
        ring, area = _hull(points)
        self.A, self.b = pypoman.compute_polytope_halfspaces(list(ring))
        return area, ring, np.asarray(pypoman.compute_chebyshev_center(A, b))


class PolytopeToolbox:
    """polytope: its intersect, reduce, volume, extreme and chebXc."""

    packages = ("polytope",)

    def start(self, A: np.ndarray, b: np.ndarray) -> None:
        import polytope

        self.lib, self.set = polytope, polytope.Polytope(A, b)

    def update(self, A: np.ndarray, b: np.ndarray) -> Answer:
        both = self.lib.Polytope(np.vstack([self.set.A, A]), np.append(self.set.b, b))
        self.set = self.lib.reduce(both)
        ring, area = _hull(self.lib.extreme(self.set))
        return area, ring, np.asarray(self.set.chebXc)


PEERS: dict[str, Callable[[], Shapely | Scipy | Cdd | Pypoman | PolytopeToolbox]] = {
    "shapely": Shapely, "scipy": Scipy, "pycddlib": Cdd, "pypoman": Pypoman, "polytope": PolytopeToolbox,
}  # fmt: skip
MODULES = {"shapely": "shapely", "scipy": "scipy", "pycddlib": "cdd", "pypoman": "pypoman", "polytope": "polytope"}


def installed() -> list[str]:
    """The peers that can be run here."""
    return [name for name, module in MODULES.items() if find_spec(module) is not None]
