"""Measures of surfaces and tet meshes for the comparison scripts, from public libraries and NumPy alone."""
import numpy as np


def edge_table(faces):
    """Undirected edges, how many faces each has, and the sum of the directions in which they run through it."""
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    way = np.where(directed[:, 0] < directed[:, 1], 1, -1)
    edges, inverse, count = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    return edges, count, np.bincount(inverse.reshape(-1), weights=way, minlength=len(edges)).astype(int)


def fans_per_vertex(faces, vertices):
    """Number of edge-connected fans of faces around each vertex: 1 in a 2-manifold."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    corner = np.arange(3 * len(faces)).reshape(-1, 3)
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    at = corner[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    low = directed[:, 0] < directed[:, 1]
    key = np.where(low[:, None], directed, directed[:, ::-1])
    ends = np.where(low[:, None], at, at[:, ::-1])
    order = np.lexsort((key[:, 1], key[:, 0]))
    key, ends = key[order], ends[order]
    same = np.flatnonzero((key[1:] == key[:-1]).all(axis=1))
    rows = np.concatenate([ends[same, 0], ends[same, 1]])
    columns = np.concatenate([ends[same + 1, 0], ends[same + 1, 1]])
    n = 3 * len(faces)
    count, name = connected_components(coo_matrix((np.ones(len(rows)), (rows, columns)), (n, n)), directed=False)
    first = np.unique(name, return_index=True)[1]
    return np.bincount(faces.reshape(-1)[first], minlength=vertices)


def topology(points, faces):
    """Open, non-manifold and misoriented edges, non-manifold vertices, Euler number, components, volume."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges, count, way = edge_table(faces)
    used = np.unique(faces)
    n = len(points)
    parts, name = connected_components(coo_matrix((np.ones(len(edges)), edges.T), (n, n)), directed=False)
    fans = fans_per_vertex(faces, n)
    a, b, c = (points[faces[:, i]] - points.mean(axis=0) for i in range(3))
    return {
        "open edges": int((count == 1).sum()),
        "non-manifold edges": int((count > 2).sum()),
        "misoriented edges": int(((count == 2) & (way != 0)).sum()),
        "non-manifold vertices": int((fans > 1).sum()),
        "euler": int(len(used) - len(edges) + len(faces)),
        "components": len(np.unique(name[used])),
        "volume_mm3": float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6),
    }


def triangle_shape(points, faces):
    """Mean and least 4√3·A/(a² + b² + c²), least and largest angle in degrees."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    squares = sum(((p - q) ** 2).sum(axis=1) for p, q in [(a, b), (b, c), (c, a)])
    quality = 4 * np.sqrt(3) * area / squares
    angles = [
        np.degrees(np.arctan2(2 * area, ((q - p) * (r - p)).sum(axis=1)))
        for p, q, r in [(a, b, c), (b, c, a), (c, a, b)]
    ]
    return {
        "mean quality": float(quality.mean()),
        "min quality": float(quality.min()),
        "min angle": float(np.min(angles)),
        "max angle": float(np.max(angles)),
    }


def sample(points, faces, count, seed=0):
    """`count` random points, evenly spread by area."""
    rng = np.random.default_rng(seed)
    a, b, c = (points[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    f = rng.choice(len(faces), count, p=area / area.sum())
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[f] + u[:, None] * (b - a)[f] + v[:, None] * (c - a)[f]


def nearest(queries, points, faces):
    """Distance from each query to the surface (libigl)."""
    import igl

    squared = igl.point_mesh_squared_distance(np.ascontiguousarray(queries), points, faces.astype(np.int64))[0]
    return np.sqrt(np.maximum(squared, 0))


def surface_distance(a, b, count=100_000):
    """Both ways between surfaces a and b, each (points, faces): RMS, 99th percentile, largest, mm."""
    there = nearest(np.vstack([sample(*a, count), a[0][np.unique(a[1])]]), *b)
    back = nearest(np.vstack([sample(*b, count), b[0][np.unique(b[1])]]), *a)
    even = np.concatenate([there[:count], back[:count]])
    return {
        "rms_mm": float(np.sqrt((even**2).mean())),
        "p99_mm": float(np.quantile(even, 0.99)),
        "max_mm": float(max(there.max(), back.max())),
        "there rms_mm": float(np.sqrt((there[:count] ** 2).mean())),
        "back rms_mm": float(np.sqrt((back[:count] ** 2).mean())),
    }


def tet_volumes(points, tets):
    """Signed volumes, mm³."""
    a, b, c, d = (points[tets[:, i]] for i in range(4))
    return np.einsum("ij,ij->i", b - a, np.cross(c - a, d - a)) / 6


def dihedral_angles(points, tets):
    """The six dihedral angles of each tet, degrees (n × 6)."""
    corners = points[tets]
    out = []
    for i, j in [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]:
        k, m = (x for x in range(4) if x not in (i, j))
        e = corners[:, j] - corners[:, i]
        e /= np.linalg.norm(e, axis=1)[:, None]
        u, v = corners[:, k] - corners[:, i], corners[:, m] - corners[:, i]
        u -= (u * e).sum(axis=1)[:, None] * e
        v -= (v * e).sum(axis=1)[:, None] * e
        out.append(np.degrees(np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), (u * v).sum(axis=1))))
    return np.array(out).T


# Faces of tet (0, 1, 2, 3) with positive volume, outward.
TET_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])


def tet_faces(tets):
    """Every face of every tet (outward), the tet that it belongs to, and for each the row of its twin or −1.

    Raises ValueError where a face has more than two tets.
    """
    faces = tets[:, TET_FACES].reshape(-1, 3)
    owner = np.repeat(np.arange(len(tets)), 4)
    key = np.sort(faces, axis=1)
    order = np.lexsort(key.T[::-1])
    same = (key[order][1:] == key[order][:-1]).all(axis=1)
    if (same[1:] & same[:-1]).any():
        raise ValueError("a face has more than two tets")
    twin = np.full(len(faces), -1)
    first = np.flatnonzero(same)
    twin[order[first]] = order[first + 1]
    twin[order[first + 1]] = order[first]
    return faces, owner, twin
