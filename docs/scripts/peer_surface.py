#!/usr/bin/env python3
"""The paper's surface chain by hand: labels → marching cubes → STL → MeshLab HC smoothing → quadric collapse.

    pip install numpy scipy scikit-image nibabel pymeshlab libigl meshio
    python peer_surface.py case_00000_segmentation.nii.gz [--faces 5000] [--hc 1] [--out organ.stl]

Prints time for each step (wall and processor seconds), then closedness, self-intersections, volume error, triangle
shape and the distance to the label's own surface. Quality threshold 0.99, the other options MeshLab's defaults.
"""
import argparse
import os
import tempfile
import time

import kidney
import measures
import numpy as np
from check_self_intersection import by_cgal, by_meshlab

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("scan")
parser.add_argument("--labels", default="1,2", help="labels of the body, by default 1,2")
parser.add_argument("--faces", type=int, default=5000)
parser.add_argument("--hc", type=int, default=1, help="applications of MeshLab's HC filter")
parser.add_argument("--topology", action="store_true", help="switch MeshLab's topology preservation on")
parser.add_argument("--out", help="write the surface here")
arguments = parser.parse_args()

import nibabel  # noqa: E402,F401  imported before the clock starts
import pymeshlab  # noqa: E402
import scipy.ndimage  # noqa: E402,F401
import skimage.measure  # noqa: E402,F401

total = [0.0, 0.0]


def step(name, work):
    wall, user = time.perf_counter(), time.process_time()
    result = work()
    wall, user = time.perf_counter() - wall, time.process_time() - user
    total[0] += wall
    total[1] += user
    print(f"{name:28} {wall:7.2f} s wall {user:7.2f} s processor")
    return result


labels = tuple(int(v) for v in arguments.labels.split(","))
mask, affine, _, voxel = step("read, largest component", lambda: kidney.read_body(arguments.scan, labels))
reading = list(total)
raw = step("marching cubes", lambda: kidney.iso_surface(mask, affine))
ms = pymeshlab.MeshSet()
with tempfile.TemporaryDirectory() as folder:
    stl = os.path.join(folder, "body.stl")

    def through_stl():
        ms.add_mesh(pymeshlab.Mesh(*raw))
        ms.save_current_mesh(stl)
        ms.clear()
        ms.load_new_mesh(stl)

    step("write and read STL", through_stl)
step("merge vertices", ms.meshing_merge_close_vertices)
step("HC Laplacian", lambda: [ms.apply_coord_hc_laplacian_smoothing() for _ in range(arguments.hc)])
step(
    "quadric edge collapse",
    lambda: ms.meshing_decimation_quadric_edge_collapse(
        targetfacenum=arguments.faces, qualitythr=0.99, preservetopology=arguments.topology
    ),
)
print(f"{'without reading':28} {total[0] - reading[0]:7.2f} s wall {total[1] - reading[1]:7.2f} s processor")
print(f"{'together':28} {total[0]:7.2f} s wall {total[1]:7.2f} s processor")

result = ms.current_mesh()
points, faces = np.asarray(result.vertex_matrix(), float), np.asarray(result.face_matrix(), np.int64)
if arguments.out:
    ms.save_current_mesh(arguments.out)
found = measures.topology(points, faces)
for name, value in found.items():
    print(f"{name:28} {value:.0f}")
print(f"{'volume error':28} {100 * (found['volume_mm3'] / (mask.sum() * voxel) - 1):.3f} %")
print(f"{'faces':28} {len(faces)} (label surface {len(raw[1])})")
pairs = by_cgal(points, faces)
print(f"{'self-intersecting faces':28} {len({f for p in pairs for f in p})} (MeshLab {len(by_meshlab(points, faces))})")
for name, value in measures.triangle_shape(points, faces).items():
    print(f"{name:28} {value:.3f}")
print("distance to the label's surface:")
for name, value in measures.surface_distance((points, faces), raw).items():
    print(f"{'  ' + name:28} {value:.3f}")
