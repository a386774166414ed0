"""A third opinion on solids, by CGAL: the library that val3dity decides with, where val3dity itself cannot be had.

    python benchmarks/solids/by_cgal.py results/SCENE/city.city.json …

In: CityJSON or CityJSONSeq (needs `pip install cgal`). For every Solid: its triangles make a manifold that is closed, looks
outward, has a positive volume and does not cut or touch itself, by exact predicates.
"""

from __future__ import annotations

import sys

import independent
import numpy as np
from CGAL import CGAL_Polygon_mesh_processing as processing
from CGAL.CGAL_Kernel import Point_3
from CGAL.CGAL_Polyhedron_3 import Polyhedron_3


def faults(faces: list[list[list[int]]], xyz: np.ndarray) -> list[str]:
    """What is wrong with a shell: faces as rings of vertex numbers, vertices (n, 3) in metres."""
    points, soup = processing.Point_3_Vector(), processing.Polygon_Vector()
    triangles = np.array([t for rings in faces for t in independent.triangles(rings, xyz)])
    used, triangles = np.unique(triangles, return_inverse=True)
    for x, y, z in (xyz[used] - np.floor(xyz[used].min(axis=0))).tolist():
        points.append(Point_3(x, y, z))
    for triangle in triangles.reshape(-1, 3).tolist():
        corners = processing.Int_Vector()
        for vertex in triangle:
            corners.append(vertex)
        soup.append(corners)
    body = Polyhedron_3()
    processing.polygon_soup_to_polygon_mesh(points, soup, body)
    if body.size_of_facets() != len(soup) or not body.is_valid():
        return ["no manifold"]
    if not body.is_closed():
        return ["not closed"]
    wrong = ["cuts itself"] if processing.does_self_intersect(body) else []
    if not processing.is_outward_oriented(body):
        wrong.append("looks inward")
    return wrong + (["no volume"] if processing.volume(body) <= 0 else [])


def main() -> None:
    """Judge every solid of the files named; ends with 1 if one is faulty."""
    bad = 0
    for path in sys.argv[1:]:
        judged = [(name, faults(faces, xyz)) for name, faces, xyz in independent.solids(path)]
        faulty = [(name, wrong) for name, wrong in judged if wrong]
        for name, wrong in faulty:
            print(f"{path}: {name}: {', '.join(wrong)}")
        print(f"{path}: {len(faulty)} of {len(judged)} solids are faulty")
        bad += len(faulty)
    raise SystemExit(bool(bad))


if __name__ == "__main__":
    main()
