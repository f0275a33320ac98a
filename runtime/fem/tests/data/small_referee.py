"""Writes small_referee.txt: static fields of a small block by scikit-fem (pip install scikit-fem), for tests/referee.rs.

A 30 x 20 x 20 mm block of 3 x 2 x 2 cubes of six tets each, E 10 kPa, nu 0.45, held at x = 0, dead traction (0, 0, -300) Pa on x = 30.
Units mm, g, s.
"""

import numpy as np
from scipy.sparse.linalg import spsolve
from skfem import Basis, BilinearForm, ElementTetP1, ElementVector, FacetBasis, LinearForm, MeshTet

E, NU = 10_000.0, 0.45
MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
TRACTION = np.array([0.0, 0.0, -300.0])

mesh = MeshTet.init_tensor(np.linspace(0, 30, 4), np.linspace(0, 20, 3), np.linspace(0, 20, 3))
basis = Basis(mesh, ElementVector(ElementTetP1()))
facets = mesh.facets_satisfying(lambda x: np.isclose(x[0], 30.0), boundaries_only=True)
face = FacetBasis(mesh, ElementVector(ElementTetP1()), facets=facets)
load = LinearForm(lambda v, w: sum(TRACTION[i] * v[i] for i in range(3))).assemble(face)
held = basis.get_dofs(lambda x: np.isclose(x[0], 0.0)).all()
free = np.setdiff1d(np.arange(basis.N), held)
EYE = np.eye(3)


def transpose(a):
    return np.einsum("ij...->ji...", a)


def hooke(e):
    return MU * (e + transpose(e)) + LAM * np.einsum("kk...,ij->ij...", e, EYE)


def rotation(f):
    m = np.moveaxis(f, (0, 1), (-2, -1))
    u, _, vt = np.linalg.svd(m)
    return np.moveaxis(u @ vt, (-2, -1), (0, 1))


def linear(f):
    return hooke(f - EYE[:, :, None, None])


def corotated(f):
    r = rotation(f)
    rt_f = np.einsum("ki...,kj...->ij...", r, f)
    return np.einsum("ik...,kj...->ij...", r, hooke(rt_f - EYE[:, :, None, None]))


def neo_hookean(f):
    m = np.moveaxis(f, (0, 1), (-2, -1))
    inverse_transpose = np.moveaxis(np.linalg.inv(m), (-2, -1), (1, 0))
    ln_j = np.log(np.linalg.det(m))
    return MU * (f - inverse_transpose) + LAM * ln_j * inverse_transpose


def solve(stress):
    u = np.zeros(basis.N)
    for _ in range(60):
        f = EYE[:, :, None, None] + basis.interpolate(u).grad
        p = stress(f)
        # dP/dF by central differences: independent of any derivation.
        d, tangent = 1e-6, np.zeros((3, 3) + f.shape)
        for k in range(3):
            for l in range(3):
                step = np.zeros_like(f)
                step[k, l] = d
                tangent[:, :, k, l] = (stress(f + step) - stress(f - step)) / (2 * d)
        inner = LinearForm(lambda v, w: np.einsum("ij...,ij...", p, v.grad)).assemble(basis)
        matrix = BilinearForm(
            lambda u, v, w: np.einsum("ijkl...,kl...,ij...", tangent, u.grad, v.grad)
        ).assemble(basis)
        residual = load - inner
        if np.linalg.norm(residual[free]) < 1e-9 * np.linalg.norm(load):
            break
        step = np.zeros(basis.N)
        step[free] = spsolve(matrix[free][:, free].tocsc(), residual[free])
        u += step
    else:
        raise SystemExit("no equilibrium")
    return u[basis.nodal_dofs]


with open("small_referee.txt", "w") as out:
    print(f"points {mesh.p.shape[1]}", file=out)
    for x in mesh.p.T:
        print(*(f"{v:.17g}" for v in x), file=out)
    print(f"tets {mesh.t.shape[1]}", file=out)
    for t in mesh.t.T:
        print(*t, file=out)
    for name, stress in [("linear", linear), ("corotated", corotated), ("neo_hookean", neo_hookean)]:
        u = solve(stress)
        print(name, np.abs(u).max())
        print(f"{name} {u.shape[1]}", file=out)
        for v in u.T:
            print(*(f"{x:.10e}" for x in v), file=out)
