#!/usr/bin/env python3
"""Count the self-intersecting faces of surfaces with tools that share no code with Palpate.

    pip install numpy meshio pymeshlab libigl
    python check_self_intersection.py organ.stl tumour.ply ...

For each file: faces that MeshLab selects, and faces and pairs that CGAL finds with exact arithmetic (through libigl).
Vertices at the same position are joined first, as an STL file has no connectivity. MeshLab tests in single precision
and misses coplanar overlaps, so CGAL is the judge. CGAL leaves out faces on the same three vertices: they are added
here as pairs of doubled faces.
"""
import sys

import numpy as np


def read(path):
    """Positions (n × 3, float64) and faces (m × 3) of a surface file, equal positions joined."""
    import meshio

    mesh = meshio.read(path)
    faces = np.vstack([c.data for c in mesh.cells if c.type == "triangle"])
    points, inverse = np.unique(np.asarray(mesh.points, float) + 0.0, axis=0, return_inverse=True)
    return points, inverse.reshape(-1)[faces]


def by_meshlab(points, faces):
    """Faces that MeshLab selects as self-intersecting."""
    import pymeshlab

    ms = pymeshlab.MeshSet()
    ms.add_mesh(pymeshlab.Mesh(points, faces))
    ms.compute_selection_by_self_intersections_per_face()
    return set(np.flatnonzero(ms.current_mesh().face_selection_array()))


def by_cgal(points, faces):
    """Pairs of faces that intersect beyond what they share, by CGAL's exact predicates."""
    from igl.copyleft import cgal

    _, _, pairs, _, _ = cgal.remesh_self_intersections(points, faces.astype(np.int64), detect_only=True)
    found = {(min(a, b), max(a, b)) for a, b in np.asarray(pairs).reshape(-1, 2).tolist()}
    key = np.sort(faces, axis=1)
    order = np.lexsort(key.T[::-1])
    doubled = np.flatnonzero((key[order][1:] == key[order][:-1]).all(axis=1))
    return found | {tuple(sorted((int(order[n]), int(order[n + 1])))) for n in doubled}


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    for path in sys.argv[1:]:
        points, faces = read(path)
        line = f"{path}: {len(faces)} faces"
        for name, tool in [("MeshLab", by_meshlab), ("CGAL", by_cgal)]:
            try:
                found = tool(points, faces)
            except ImportError as missing:
                line += f", {name}: not installed ({missing.name})"
                continue
            if name == "CGAL":
                hit = {f for pair in found for f in pair}
                line += f", CGAL: {len(hit)} intersecting faces in {len(found)} pairs"
            else:
                line += f", {name}: {len(found)} intersecting faces"
        print(line)
