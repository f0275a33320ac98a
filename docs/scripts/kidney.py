"""Reads one body of a segmented scan with nibabel, for the comparison scripts."""
import numpy as np


def read_body(path, labels=(1, 2), pad=2):
    """The largest connected body of `labels`: (mask of its box with `pad` empty voxels around, affine of the mask,
    label values in the box, voxel volume in mm³)."""
    import nibabel
    from scipy import ndimage

    image = nibabel.load(path)
    data = np.asanyarray(image.dataobj)
    wanted = np.isin(data, labels) if len(labels) > 1 else data == labels[0]
    box = ndimage.find_objects(wanted.view(np.uint8))[0]
    parts, _ = ndimage.label(wanted[box])
    sizes = np.bincount(parts.reshape(-1))
    sizes[0] = 0
    body = parts == sizes.argmax()
    inner = ndimage.find_objects(body.view(np.uint8))[0]
    start = np.array([b.start + i.start for b, i in zip(box, inner)])
    mask = np.pad(body[inner], pad)
    values = np.pad(data[box][inner], pad)
    affine = image.affine.copy()
    affine[:3, 3] = image.affine[:3, :3] @ (start - pad) + image.affine[:3, 3]
    return mask, affine, values, abs(np.linalg.det(affine[:3, :3]))


def iso_surface(mask, affine):
    """Marching cubes on the mask as drawn, in patient mm, facing outward."""
    from skimage import measure

    points, faces, _, _ = measure.marching_cubes(mask.astype(np.float32), 0.5)
    points = points.astype(float) @ affine[:3, :3].T + affine[:3, 3]
    a, b, c = (points[faces[:, i]] - points[0] for i in range(3))
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0:
        faces = faces[:, ::-1]
    return points, np.ascontiguousarray(faces, np.int64)
