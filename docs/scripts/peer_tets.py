#!/usr/bin/env python3
"""Tetrahedra in a closed surface by TetGen and fTetWild, for comparison with the FEM mesh of a package.

    pip install numpy scipy meshio tetgen pytetwild pymeshfix
    python peer_tets.py organ.stl [--tets 13000] [--tools tetgen,tetgen-meshfix,ftetwild]

The surface is one that peer_surface.py or `build-model export` wrote. Each tool runs in a process of its own, as TetGen
ends its process on some surfaces. Prints time (wall and processor seconds, start of Python excluded), counts, extreme
dihedral angles, volume error against the surface, and whether the boundary is closed and manifold.
"""
import argparse
import multiprocessing
import os
import tempfile
import time

import measures
import numpy as np
from check_self_intersection import read


def by_tetgen(points, faces, tets):
    import tetgen

    # No largest volume: a surface of 5000 faces forces more than 13 000 tets by itself.
    return lambda: tetgen.TetGen(points, faces.astype(np.int32)).tetrahedralize(order=1, mindihedral=10, minratio=1.5)[:2]


def by_tetgen_after_meshfix(points, faces, tets):
    import pymeshfix

    def work():
        fixed = pymeshfix.MeshFix(points, faces.astype(np.int32))
        fixed.repair()
        return by_tetgen(np.asarray(fixed.points), np.asarray(fixed.faces), tets)()

    return work


def by_ftetwild(points, faces, tets):
    import pytetwild

    # Its edge length is relative to the box; regular tets of edge h have h³/(6·√2) each.
    volume = measures.topology(points, faces)["volume_mm3"]
    edge = (volume / tets * 6 * np.sqrt(2)) ** (1 / 3)
    diagonal = np.linalg.norm(np.ptp(points, axis=0))
    return lambda: pytetwild.tetrahedralize(points, faces.astype(np.int32), edge_length_fac=edge / diagonal)[:2]


TOOLS = {"tetgen": by_tetgen, "tetgen-meshfix": by_tetgen_after_meshfix, "ftetwild": by_ftetwild}


def run(tool, points, faces, tets, out):
    # TetGen and fTetWild leave files in the working folder.
    os.chdir(tempfile.mkdtemp())
    work = TOOLS[tool](points, faces, tets)
    wall, user = time.perf_counter(), time.process_time()
    nodes, cells = work()
    out.put((np.asarray(nodes, float), np.asarray(cells), time.perf_counter() - wall, time.process_time() - user))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("surface")
    parser.add_argument("--tets", type=int, default=13000)
    parser.add_argument("--tools", default=",".join(TOOLS))
    arguments = parser.parse_args()
    points, faces = read(arguments.surface)
    volume = measures.topology(points, faces)["volume_mm3"]
    context = multiprocessing.get_context("spawn")
    for tool in arguments.tools.split(","):
        out = context.Queue()
        process = context.Process(target=run, args=(tool, points, faces, arguments.tets, out))
        process.start()
        result = None
        while result is None and (process.is_alive() or not out.empty()):
            try:
                result = out.get(timeout=0.5)
            except Exception:  # queue.Empty: look again whether the process lives
                continue
        process.join()
        if result is None:
            print(f"{tool}: failed, exit code {process.exitcode}")
            continue
        nodes, cells, wall, user = result
        volumes = measures.tet_volumes(nodes, cells)
        cells = np.where((volumes < 0)[:, None], cells[:, [0, 2, 1, 3]], cells)
        angles = measures.dihedral_angles(nodes, cells)
        try:
            boundary, _, twin = measures.tet_faces(cells)
            found = measures.topology(nodes, boundary[twin < 0])
            closed = ", ".join(f"{name} {found[name]}" for name in ["open edges", "non-manifold edges", "non-manifold vertices"])
        except ValueError as fault:
            closed = str(fault)
        print(
            f"{tool}: {wall:.2f} s wall, {user:.2f} s processor, {len(cells)} tets, {len(np.unique(cells))} nodes, "
            f"dihedral {angles.min():.2f}°–{angles.max():.2f}°, {int((angles < 10).any(axis=1).sum())} tets under 10°, "
            f"volume error {100 * (np.abs(volumes).sum() / abs(volume) - 1):.3f} %; boundary: {closed}",
            flush=True,
        )
