#!/usr/bin/env python3
"""Compare two output folders of `rehearse run` on the same scene, such as one on the CPU and one on a GPU.

    pip install numpy pyvista
    python compare_sessions.py out-cpu out-gpu

For every grid that both folders hold: over the points that have moved more than 1 mm since the first grid of their
series, mean, 99th percentile and largest distance in mm. Then the largest difference of fiducials (mm) and force (N).
"""
import pathlib
import sys

import numpy as np
import pyvista

first, second = (pathlib.Path(a) for a in sys.argv[1:3])
start = {}
for path in sorted((first / "vtu").glob("*.vtu")):
    series = path.stem.rsplit("-", 1)[0]
    if series.startswith(("instrument", "support")):
        continue
    a = pyvista.read(path).points
    b = pyvista.read(second / "vtu" / path.name).points
    moved = np.linalg.norm(a - start.setdefault(series, a), axis=1) > 1.0
    if moved.any():
        d = np.linalg.norm(a - b, axis=1)[moved]
        print(f"{path.name:28} {moved.sum():6} points  mean {d.mean():.6f}  p99 {np.percentile(d, 99):.6f}  most {d.max():.6f} mm")
a, b = (np.load(f / "session.npz") for f in (first, second))
for name in ("fiducials_mm", "force_n"):
    print(f"{name}: largest difference {np.abs(a[name] - b[name]).max():.6f} over {len(a[name])} steps")
