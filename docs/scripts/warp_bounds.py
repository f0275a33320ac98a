#!/usr/bin/env python3
"""Worst dihedral angles of the stuffing stencils for given warp constants (docs/decisions.md).

    pip install numpy
    python warp_bounds.py 0.285 0.399

All sign patterns of one lattice tet, all lattice directions in which a warped corner can have moved (never towards another
warped corner of the tet), displacements and cuts at the ends of their ranges. Angles in degrees, lengths in half lattice edges.
"""
import itertools
import sys

import numpy as np

CORNERS = np.array([[0, 0, 0], [2, 0, 0], [1, 1, 1], [1, 1, -1]], float)
LONG = [np.eye(3)[a] * 2 * s for a in range(3) for s in (-1, 1)]
SHORT = [np.array(d, float) for d in itertools.product((-1, 1), repeat=3)]


def is_long(i, j):
    return (i < 2) == (j < 2)


def first_diagonal(a, b, e):
    """Whether the quad of inside corners a, b and outside corner e is cut from a to the cut on b-e."""
    if is_long(e, a) or is_long(e, b):
        return is_long(e, b)
    greater = int(np.sum(CORNERS[a] > (CORNERS[b] + CORNERS[e]) / 2))
    return greater % 2 == (1 if a < 2 else 0)


def stencil(signs, at, cut):
    """Tets of a sign pattern: `at(i)` a corner, `cut(i, o)` the cut between inside i and outside o."""
    inside, on, outside = ([i for i in range(4) if signs[i] == s] for s in (-1, 0, 1))

    def pyramid(apex, a, b, e):
        c, d = cut(b, e), cut(a, e)
        if first_diagonal(a, b, e):
            return [(apex, at(a), at(b), c), (apex, at(a), c, d)]
        return [(apex, at(a), at(b), d), (apex, at(b), c, d)]

    if not outside:
        return [tuple(at(i) for i in range(4))]
    if len(inside) == 1:
        return [(at(inside[0]), *(at(i) for i in on), *(cut(inside[0], o) for o in outside))]
    if len(inside) == 3:
        e = outside[0]
        far = next(i for i in inside if is_long(i, e))
        b, c = (i for i in inside if i != far)
        return [(at(far), at(b), at(c), cut(far, e)), *pyramid(cut(far, e), b, c, e)]
    a, b = inside
    if on:
        return pyramid(at(on[0]), a, b, outside[0])
    e, f = outside
    assert first_diagonal(a, b, e) != first_diagonal(a, b, f)
    if not first_diagonal(a, b, e):
        e, f = f, e
    return [
        (at(a), at(b), cut(b, e), cut(a, f)),
        (at(a), cut(b, e), cut(a, e), cut(a, f)),
        (at(b), cut(b, e), cut(b, f), cut(a, f)),
    ]


def extremes(tet):
    """Smallest and largest dihedral angle over arrays of tets."""
    low, high = 180.0, 0.0
    for i, j in itertools.combinations(range(4), 2):
        k, l = (n for n in range(4) if n not in (i, j))
        edge, u, w = tet[j] - tet[i], tet[k] - tet[i], tet[l] - tet[i]
        volume = np.abs(np.sum(edge * np.cross(u, w), axis=-1))
        cosine = np.sum(np.cross(edge, u) * np.cross(edge, w), axis=-1)
        angle = np.degrees(np.arctan2(volume * np.linalg.norm(edge, axis=-1), cosine))
        low, high = min(low, angle.min()), max(high, angle.max())
    return low, high


def bounds(alpha_long, alpha_short):
    low, high = 180.0, 0.0
    for signs in itertools.product((-1, 0, 1), repeat=4):
        on = [i for i in range(4) if signs[i] == 0]
        if -1 not in signs:
            continue
        cuts = [(i, o) for i in range(4) for o in range(4) if signs[i] < 0 < signs[o]]
        choices = []
        for i in on:
            moves = [d * a for ds, a in ((LONG, alpha_long), (SHORT, alpha_short)) for d in ds
                     if not any(j != i and np.allclose(CORNERS[j] - CORNERS[i], d) for j in on)]
            choices.append(np.array([CORNERS[i], *(CORNERS[i] + m for m in moves)]))
        for i, o in cuts:
            a = alpha_long if is_long(i, o) else alpha_short
            choices.append(np.array([CORNERS[i] * (1 - t) + CORNERS[o] * t for t in (a, 1 - a)]))
        grid = np.meshgrid(*(np.arange(len(c)) for c in choices), indexing="ij")
        points = [c[g.ravel()] for c, g in zip(choices, grid)]
        size = len(points[0]) if points else 1
        moved = dict(zip([*on, *cuts], points))
        still = [np.broadcast_to(c, (size, 3)) for c in CORNERS]
        for tet in stencil(signs, lambda i: moved.get(i, still[i]), lambda i, o: moved[i, o]):
            found = extremes(tet)
            low, high = min(low, found[0]), max(high, found[1])
    return low, high


if __name__ == "__main__":
    print("%.4f %.4f" % bounds(float(sys.argv[1]), float(sys.argv[2])))
