#!/usr/bin/env python3
"""Judge a model package, and its exported files, against the scan, with public libraries and none of our code.

    pip install numpy scipy nibabel scikit-image meshio pymeshlab libigl pyvista
    build-model case_00000_segmentation.nii.gz --preset kits19 --component largest -o case.palpate
    build-model export case.palpate --format stl -o exported      (also ply, obj, vtu)
    python judge_package.py case_00000_segmentation.nii.gz case.palpate --export exported

Every line says `ok`, `FAIL` or `note`; the exit code is the number of failures, at most 99. The reference is the label
map as nibabel reads it: the connected body that the package's organ covers, and skimage's surface of its raw mask.
"""
import argparse
import hashlib
import io
import json
import pathlib
import sys
import zipfile

import kidney
import measures
import numpy as np
from check_self_intersection import by_cgal, by_meshlab, read
from scipy import ndimage
from scipy.spatial import cKDTree

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("scan")
parser.add_argument("package")
parser.add_argument("--export", action="append", default=[], help="folder with exported files; may be given again")
parser.add_argument("--organ", default="1,2", help="labels of the organ with its structures (default 1,2)")
parser.add_argument("--structure", action="append", default=[], help="NAME=LABELS (default tumour=2)")
parser.add_argument("--brief", action="store_true", help="failures and notes only")
arguments = parser.parse_args()
structures = dict(s.split("=") for s in arguments.structure or ["tumour=2"])
numbers = {name: [int(v) for v in labels.split(",")] for name, labels in structures.items()}

failures = 0


def say(good, text):
    global failures
    failures += good is False
    if not (arguments.brief and good):
        print({True: "ok  ", False: "FAIL", None: "note"}[good], text, flush=True)


archive = zipfile.ZipFile(arguments.package)
say(archive.testzip() is None, "every entry of the archive passes its CRC")
manifest = json.loads(archive.read("manifest.json"))
arrays = {}
for entry in manifest["entries"]:
    data = archive.read(entry["name"])
    if hashlib.sha256(data).hexdigest() != entry["sha256"]:
        say(False, f"{entry['name']}: digest differs from the manifest")
    arrays[entry["name"][: -len(".npy")]] = np.load(io.BytesIO(data))
listed = {e["name"] for e in manifest["entries"]} | {"manifest.json"}
say(listed == set(archive.namelist()), "the manifest lists every entry")
say(all(np.isfinite(a).all() for a in arrays.values() if a.dtype.kind == "f"), "all numbers are finite")
origin = np.array(manifest["local_origin_mm"])
regions = manifest["regions"]


def patient(name):
    return arrays[name].astype(float) + origin


# The scan: the body that the package's organ covers.
import nibabel  # noqa: E402

image = nibabel.load(arguments.scan)
data = np.asanyarray(image.dataobj)
if data.ndim == 4:
    data = data[..., 0]
wanted = np.isin(data, [int(v) for v in arguments.organ.split(",")])
inverse = np.linalg.inv(image.affine)
organ_info = next(s for s in manifest["surfaces"] if s["kind"] == "organ")
organ_points = patient(organ_info["folder"] + "/vertices")
at = organ_points @ inverse[:3, :3].T + inverse[:3, 3]
low = np.maximum(np.floor(at.min(axis=0)).astype(int) - 3, 0)
high = np.minimum(np.ceil(at.max(axis=0)).astype(int) + 4, data.shape)
box = tuple(slice(a, b) for a, b in zip(low, high))
parts, count = ndimage.label(wanted[box])
inner = tuple(slice(3, -3) for _ in range(3))
near = np.bincount(parts[inner].reshape(-1), minlength=count + 1)
near[0] = 0
body = parts == near.argmax()
pad = 3
affine = image.affine.copy()
affine[:3, 3] = image.affine[:3, :3] @ (low - pad) + image.affine[:3, 3]
body = np.pad(body, pad)
values = np.pad(data[box], pad)
voxel = abs(np.linalg.det(affine[:3, :3]))
spacing = np.linalg.norm(affine[:3, :3], axis=0)
touches = [(low[a] == 0 and body[(slice(None),) * a + (pad,)].any()) or
           (high[a] == data.shape[a] and body[(slice(None),) * a + (-pad - 1,)].any()) for a in range(3)]
thin = spacing.max() <= 1.25
say(None, f"scan: spacing {np.round(spacing, 3)} mm, body {body.sum() * voxel:.0f} mm³, cut by the border on axes {touches}")

labels = arrays["labels/data"].transpose(2, 1, 0)
label_affine = arrays["labels/affine"]
label_voxel = abs(np.linalg.det(label_affine[:, :3]))
names = manifest["label_names"]
is_region = (labels > 0) & (labels <= len(regions))
repaired = {"": is_region.sum() * label_voxel}
for n, name in enumerate(names):
    repaired[name] = (labels == n + 1).sum() * label_voxel


def body_of(kind, name):
    """Reference mask and repaired voxel volume of a surface."""
    if kind == "organ":
        return body, repaired[""]
    if kind == "structure" and name in numbers:
        parts, count = ndimage.label(body & np.isin(values, numbers[name]))
        # Specks under 30 mm³ are dropped by the default recipe, and reported.
        sizes = np.bincount(parts.reshape(-1), minlength=count + 1) * voxel
        sizes[0] = 0
        return np.isin(parts, np.flatnonzero(sizes >= 30)), repaired.get(name, 0.0)
    return None, repaired.get(name)


def judge_surface(title, points, faces, mask, volume, exact):
    found = measures.topology(points, faces)
    whole = all(found[k] == 0 for k in ["open edges", "non-manifold edges", "misoriented edges", "non-manifold vertices"])
    say(whole, f"{title}: {len(faces)} faces, closed and 2-manifold: {found}")
    say(found["volume_mm3"] > 0, f"{title}: faces outward")
    say(found["components"] == 1 and found["euler"] == 2, f"{title}: one body without handles (Euler {found['euler']}, {found['components']} parts)")
    pairs = by_cgal(points, faces)
    say(not pairs, f"{title}: self-intersections by CGAL {len(pairs)} pairs {sorted(pairs)[:5]}, by MeshLab {len(by_meshlab(points, faces))} faces")
    shape = measures.triangle_shape(points, faces)
    say(shape["min angle"] >= 15 and shape["mean quality"] >= 0.9, f"{title}: " + ", ".join(f"{k} {v:.3f}" for k, v in shape.items()))
    if volume:
        off = found["volume_mm3"] - volume
        say(abs(off) <= max(0.005 * volume, 20), f"{title}: volume {found['volume_mm3']:.1f} mm³, {off:+.1f} mm³ ({100 * off / volume:+.3f} %) against the repaired voxels")
    if mask is None or not mask.any() or not exact:
        return
    drawn = mask.sum() * voxel
    off = found["volume_mm3"] - drawn
    say(None, f"{title}: {off:+.1f} mm³ ({100 * off / drawn:+.3f} %) against the voxels as drawn")
    # Enclosed voids are filled on purpose; their walls are no surface of the body.
    raw = kidney.iso_surface(ndimage.binary_fill_holes(mask), affine)
    d = measures.surface_distance((points, faces), raw)
    line = f"{title}: distance to skimage's surface of the raw mask: " + ", ".join(f"{k} {v:.3f}" for k, v in d.items())
    say((d["rms_mm"] <= 0.25 and d["p99_mm"] <= 0.8) if thin and not any(touches) else None, line)


for info in manifest["surfaces"]:
    folder = info["folder"]
    mask, volume = body_of(info["kind"], info["name"])
    points, faces = patient(folder + "/vertices"), arrays[folder + "/triangles"].astype(np.int64)
    judge_surface(f"surface {info['name']}", points, faces, mask, volume, True)
    if folder + "/skin_weights" in arrays:
        weights = arrays[folder + "/skin_weights"]
        say(bool((weights >= 0).all() and np.abs(weights.sum(axis=1) - 1).max() < 1e-5), f"surface {info['name']}: weights sum to 1")

# FEM mesh.
nodes, tets, region = patient("fem/vertices"), arrays["fem/tets"].astype(np.int64), arrays["fem/regions"]
volumes = measures.tet_volumes(nodes, tets)
angles = measures.dihedral_angles(nodes, tets)
inside = (angles.min() >= 12) and (angles.max() <= 160)
say(bool((volumes > 0).all()), f"fem: {len(tets)} tets, {len(nodes)} nodes, least volume {volumes.min():.3g} mm³")
say(bool(inside), f"fem: dihedral {angles.min():.2f}°–{angles.max():.2f}°, {int((angles < 15).any(axis=1).sum())} tets under 15°, {int((angles > 150).any(axis=1).sum())} over 150°")
say(len(np.unique(tets)) == len(nodes), "fem: no node unused")
say(len(np.unique(np.round(nodes, 6), axis=0)) == len(nodes), "fem: no two nodes at one place")
try:
    faces, owner, twin = measures.tet_faces(tets)
except ValueError as fault:
    say(False, f"fem: {fault}")
    faces = None
if faces is not None:
    boundary = faces[twin < 0]
    found = measures.topology(nodes, boundary)
    whole = all(found[k] == 0 for k in ["open edges", "non-manifold edges", "misoriented edges", "non-manifold vertices"])
    say(whole, f"fem: boundary of {len(boundary)} faces closed and 2-manifold: {found}")
    say(found["components"] == 1 and found["euler"] == 2, f"fem: boundary is one body without handles (Euler {found['euler']}, {found['components']} parts)")
    pairs = by_cgal(nodes, boundary)
    say(not pairs, f"fem: boundary self-intersections by CGAL {len(pairs)} pairs {sorted(pairs)[:5]}")
    paired = np.flatnonzero(twin >= 0)
    say(bool((np.sort(faces[paired], axis=1) == np.sort(faces[twin[paired]], axis=1)).all()), "fem: neighbours share their three nodes")
    same_way = (faces[paired][:, [1, 2, 0]] == faces[twin[paired]]).all(axis=1) | (faces[paired][:, [2, 0, 1]] == faces[twin[paired]]).all(axis=1) | (faces[paired] == faces[twin[paired]]).all(axis=1)
    say(not same_way.any(), "fem: neighbours lie on opposite sides of their face")
    off = volumes.sum() - repaired[""]
    say(abs(off) <= max(0.005 * repaired[""], 20), f"fem: volume {volumes.sum():.1f} mm³, {100 * off / repaired['']:+.3f} % against the repaired voxels")
    mask_surface = kidney.iso_surface(ndimage.binary_fill_holes(body), affine)
    pairs = np.unique(np.sort(tets[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2), axis=1), axis=0)
    edges = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
    edge = edges.mean()
    lengths = edges.min(), np.quantile(edges, 0.01), edge, edges.max()
    # Good dihedral angles do not rule out needles: an edge much shorter than the rest makes the system stiff.
    say(bool(lengths[0] >= 0.1 * edge), "fem: edges shortest {:.4f}, 1st percentile {:.3f}, mean {:.3f}, longest {:.3f} mm".format(*lengths))
    heights = 3 * volumes / np.max([0.5 * np.linalg.norm(np.cross(nodes[f[:, 1]] - nodes[f[:, 0]], nodes[f[:, 2]] - nodes[f[:, 0]]), axis=1) for f in (tets[:, t] for t in measures.TET_FACES)], axis=0)
    say(None, f"fem: least height {heights.min():.4f} mm, {int((heights < 0.1 * edge).sum())} tets under a tenth of the mean edge")
    d = measures.surface_distance((nodes, boundary), mask_surface, 30_000)
    say(None, "fem: boundary to skimage's surface of the raw mask: " + ", ".join(f"{k} {v:.3f}" for k, v in d.items()) + f" (edge {edge:.2f} mm)")
    d = measures.surface_distance((nodes, boundary), (organ_points, arrays[organ_info["folder"] + "/triangles"].astype(np.int64)), 30_000)
    # Where the mesh leaves out a thin part, the way from the collision surface tells.
    say(bool(d["max_mm"] <= 2 * edge), "fem: boundary to the collision surface: " + ", ".join(f"{k} {v:.3f}" for k, v in d.items()))
    for code, name in enumerate(regions):
        mine = volumes[region == code].sum()
        if name not in repaired or repaired[name] == 0:
            say(None, f"fem: region {name}: no voxels of that name")
            continue
        off = mine - repaired[name]
        tagged = any(t["name"] == name for t in manifest.get("tagged", []))
        say(None if tagged else bool(abs(off) <= max(0.01 * repaired[name], 20)), f"fem: region {name}: {(region == code).sum()} tets, {mine:.1f} mm³, {100 * off / repaired[name]:+.3f} % ({off:+.1f} mm³) against its repaired voxels")
        if code == 0 or not (region == code).any():
            continue
        # The region's own skin, and the part of it that lies inside the organ.
        skin = faces[(region[owner] == code) & ((twin < 0) | (region[owner[twin]] != code))]
        between = faces[(region[owner] == code) & (twin >= 0) & (region[owner[twin]] != code)]
        found = measures.topology(nodes, skin)
        whole = all(found[k] == 0 for k in ["open edges", "non-manifold edges", "non-manifold vertices"])
        say(whole, f"fem: region {name} is bounded by a closed 2-manifold: {found}")
        pairs = by_cgal(nodes, skin)
        say(not pairs, f"fem: region {name}: self-intersections of its skin by CGAL {len(pairs)} pairs")
        parts, _ = ndimage.label(body & np.isin(values, numbers.get(name, [])))
        if len(between) and parts.any():
            raw = kidney.iso_surface(parts > 0, affine)
            d = measures.nearest(measures.sample(nodes, between, 20_000), *raw)
            say(None, f"fem: region {name}: {len(between)} inner faces to the raw label surface: rms {np.sqrt((d**2).mean()):.3f}, p99 {np.quantile(d, 0.99):.3f}, max {d.max():.3f} mm")
        used = np.unique(tets[region == code])
        links = measures.edge_table(skin)[0]
        say(None, f"fem: region {name}: {len(used)} nodes, {len(links)} edges in its skin")

# Particles and clusters.
particles = patient("particles/positions")
radius = manifest["particles"]["radius_mm"]
offsets, members = arrays["clusters/offsets"].astype(int), arrays["clusters/members"].astype(int)
index = np.argwhere(is_region)
centres = index @ label_affine[:, :3].T + label_affine[:, 3]
tree = cKDTree(particles)
gap = tree.query(centres)[0]
# Voxels that the smooth surface leaves outside do not count.
organ_faces = arrays[organ_info["folder"] + "/triangles"].astype(np.int64)
far = np.flatnonzero(gap > radius)
if len(far):
    import igl

    far = far[igl.fast_winding_number(organ_points, organ_faces, centres[far]) > 0.5]
worst = gap[far].max() if len(far) else gap[gap <= radius].max()
say(bool(worst <= radius + 1e-4), f"particles: {len(particles)}, radius {radius} mm; the farthest voxel centre inside the organ's surface is {worst / radius:.3f} radii from one ({len(far)} beyond 1; of voxels that the surface leaves out {int((gap > radius).sum()) - len(far)})")
spread = tree.query(particles, k=2)[0][:, 1]
say(None, f"particles: nearest neighbour {spread.min() / radius:.3f}…{spread.max() / radius:.3f} radii")
say(len(np.unique(members)) == len(particles), f"clusters: {len(offsets) - 1}, {len(members)} memberships; every particle belongs to one")
ratios, links = [], []
for c in range(len(offsets) - 1):
    m = members[offsets[c] : offsets[c + 1]]
    q = particles[m] - particles[m].mean(axis=0)
    s = np.linalg.svd(q.T @ q, compute_uv=False)
    ratios.append(s[2] / s[0])
    links.extend((m[0], k) for k in m[1:])
say(min(ratios) >= 0.05, f"clusters: σmin/σmax of the moment matrix at least {min(ratios):.4f}")
from scipy.sparse import coo_matrix  # noqa: E402
from scipy.sparse.csgraph import connected_components  # noqa: E402

links = np.array(links)
parts = connected_components(coo_matrix((np.ones(len(links)), links.T), (len(particles),) * 2), directed=False)[0]
say(parts == 1, f"clusters: connected in {parts} part(s)")
masses = manifest["particles"]["mass_g"] * len(particles)
say(None, f"particles: together {masses:.1f} g, density {masses / repaired['']*1e3:.3f} g/cm³")

# Embedding mesh: every organ voxel in exactly one tet.
nodes, tets = patient("embedding/vertices"), arrays["embedding/tets"].astype(np.int64)
volumes = measures.tet_volumes(nodes, tets)
say(bool((volumes > 0).all()) and 1500 <= len(tets) <= 3000, f"embedding: {len(tets)} tets, least volume {volumes.min():.3g} mm³")
held = np.zeros(len(centres), int)
order = cKDTree(centres)
for a, b, c, d in nodes[tets]:
    m = (a + b + c + d) / 4
    near = np.array(order.query_ball_point(m, max(np.linalg.norm(p - m) for p in (a, b, c, d)) + 1e-9), int)
    if len(near) == 0:
        continue
    w = np.linalg.solve(np.array([b - a, c - a, d - a]).T, (centres[near] - a).T)
    share = np.vstack([1 - w.sum(axis=0), w]).min(axis=0)
    held[near[share > 1e-9]] += 1
    held[near[np.abs(share) <= 1e-9]] += 1000
say(bool((held > 0).all()), f"embedding: organ voxels in no tet: {int((held == 0).sum())} of {len(held)}")
say(not ((held % 1000) > 1).any(), f"embedding: voxels inside more than one tet: {int(((held % 1000) > 1).sum())}; on a shared face: {int((held >= 1000).sum())}")

# Exported files.
for folder in arguments.export:
    for path in sorted(pathlib.Path(folder).rglob("*")):
        if path.suffix in (".stl", ".ply", ".obj") and path.is_file():
            try:
                points, faces = read(path)
            except Exception as fault:  # a reader's refusal is the finding
                import meshio

                try:
                    mesh = meshio.read(path)
                    say(None, f"{path.name}: {len(mesh.points)} points, cells {[(c.type, len(c.data)) for c in mesh.cells]}")
                except Exception:
                    say(None, f"{path.name}: meshio does not read it as a surface: {type(fault).__name__}: {fault}")
                continue
            info = next((s for s in manifest["surfaces"] if path.stem == s["folder"].split("/")[1]), None)
            if info is None:
                found = measures.topology(points, faces)
                whole = all(found[k] == 0 for k in ["open edges", "non-manifold edges", "misoriented edges", "non-manifold vertices"])
                say(whole and found["volume_mm3"] > 0, f"{path.name}: {len(faces)} faces, closed, 2-manifold, outward: {found}")
                continue
            reference = patient(info["folder"] + "/vertices")
            apart = cKDTree(reference).query(points)[0].max()
            say(len(points) == len(reference) and apart < 1e-3, f"{path.name}: {len(points)} of {len(reference)} vertices, within {apart:.2g} mm of the package's, patient mm")
            judge_surface(path.name, points, faces, None, body_of(info["kind"], info["name"])[1], False)
        elif path.suffix == ".vtu":
            import meshio

            try:
                mesh = meshio.read(path)
            except (Exception, SystemExit) as fault:  # meshio ends the process on some files
                say(False, f"{path.name}: meshio does not read it: {fault}")
                import pyvista

                grid = pyvista.read(path)
                say(None, f"{path.name}: VTK reads it: {grid.n_points} points, {grid.n_cells} cells, cell data {grid.cell_data.keys()}, point data {grid.point_data.keys()}, field data {grid.field_data.keys()}")
                points, cells = np.asarray(grid.points, float), grid.cells_dict.get(10)
            else:
                kinds = {c.type: len(c.data) for c in mesh.cells}
                say(None, f"{path.name}: {len(mesh.points)} points, {kinds}, cell data {list(mesh.cell_data)}, point data {list(mesh.point_data)}")
                points, cells = np.asarray(mesh.points, float), None
                if "tetra" in kinds:
                    cells = np.vstack([c.data for c in mesh.cells if c.type == "tetra"])
            if cells is not None:
                volumes = measures.tet_volumes(points, cells)
                say(bool((volumes > 0).all()), f"{path.name}: {len(cells)} tets, least volume {volumes.min():.3g} mm³, together {volumes.sum():.1f} mm³")
            stem = path.stem.split("-")[-1].split("_")[-1]
            if f"{stem}/vertices" in arrays:
                apart = np.abs(points - patient(f"{stem}/vertices")).max()
                say(bool(apart < 1e-3), f"{path.name}: nodes within {apart:.2g} mm of the package's, patient mm")
print(f"{failures} failures")
sys.exit(min(failures, 99))
