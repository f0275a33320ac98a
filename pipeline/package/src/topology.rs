use crate::PackageError;

/// Rows in `offsets` must rise from 0 to `len`.
pub(crate) fn check_offsets(entry: &str, offsets: &[u32], len: usize) -> Result<(), PackageError> {
    match offsets.first() {
        None => {
            return Err(PackageError::invalid(
                entry,
                "row 0",
                "no offsets",
                "a first offset of 0",
            ));
        }
        Some(&first) if first != 0 => {
            return Err(PackageError::invalid(
                entry,
                "row 0",
                format!("offset {first}"),
                "0",
            ));
        }
        _ => {}
    }
    if let Some(i) = offsets.windows(2).position(|w| w[1] < w[0]) {
        return Err(PackageError::invalid(
            entry,
            format!("row {}", i + 1),
            format!("offset {} after {}", offsets[i + 1], offsets[i]),
            "offsets that never fall",
        ));
    }
    match offsets.last() {
        Some(&last) if last as usize != len => Err(PackageError::invalid(
            entry,
            format!("row {}", offsets.len() - 1),
            format!("last offset {last}"),
            format!("{len}, the number of entries"),
        )),
        _ => Ok(()),
    }
}

/// Each index must be below `count`.
pub(crate) fn check_indices(
    entry: &str,
    indices: &[u32],
    count: usize,
    of: &str,
) -> Result<(), PackageError> {
    match indices.iter().position(|&v| v as usize >= count) {
        None => Ok(()),
        Some(i) => Err(out_of_range(entry, i, indices[i], count, of)),
    }
}

/// Each index of each row must be below `count`.
pub(crate) fn check_rows<const K: usize>(
    entry: &str,
    rows: &[[u32; K]],
    count: usize,
    of: &str,
) -> Result<(), PackageError> {
    match rows.iter().flatten().position(|&v| v as usize >= count) {
        None => Ok(()),
        Some(i) => Err(out_of_range(entry, i / K, rows[i / K][i % K], count, of)),
    }
}

fn out_of_range(entry: &str, row: usize, value: u32, count: usize, of: &str) -> PackageError {
    PackageError::invalid(
        entry,
        format!("row {row}"),
        format!("index {value}"),
        format!("below {count}, the number of {of}"),
    )
}

/// For each of `count` targets the positions in `members` that hold it, ascending: (offsets, entries).
/// Every member must be below `count`.
pub(crate) fn transpose(members: &[u32], count: usize) -> (Vec<u32>, Vec<u32>) {
    let mut offsets = vec![0u32; count + 1];
    for &m in members {
        offsets[m as usize + 1] += 1;
    }
    for p in 0..count {
        offsets[p + 1] += offsets[p];
    }
    let mut next = offsets.clone();
    let mut entries = vec![0u32; members.len()];
    for (i, &m) in members.iter().enumerate() {
        let at = &mut next[m as usize];
        entries[*at as usize] = i as u32;
        *at += 1;
    }
    (offsets, entries)
}

/// Outer faces of a tet mesh, facing outward: (vertices of the face, tet), in order of tet and face.
/// A face between two regions counts as outer for both where `split_regions` is given.
pub(crate) fn boundary_faces(tets: &[[u32; 4]], split_regions: Option<&[u16]>) -> Vec<([u32; 3], u32)> {
    let faces = sorted_faces(tets);
    let mut keep = Vec::new();
    let mut i = 0;
    while i < faces.len() {
        let mut j = i + 1;
        while j < faces.len() && faces[j].0 == faces[i].0 {
            j += 1;
        }
        let region = |f: &([u32; 3], u32)| split_regions.and_then(|r| r.get((f.1 / 4) as usize)).copied();
        if j - i == 1 || region(&faces[i]) != region(&faces[i + 1]) {
            keep.extend(faces[i..j].iter().map(|f| f.1));
        }
        i = j;
    }
    keep.sort_unstable();
    keep.iter()
        .map(|&f| (face(&tets[(f / 4) as usize], (f % 4) as usize), f / 4))
        .collect()
}

/// Face `f` of a positive tet, counter-clockwise seen from outside it.
pub(crate) fn face(t: &[u32; 4], f: usize) -> [u32; 3] {
    match f {
        0 => [t[1], t[2], t[3]],
        1 => [t[0], t[3], t[2]],
        2 => [t[0], t[1], t[3]],
        _ => [t[0], t[2], t[1]],
    }
}

/// All faces by sorted vertices, with 4·tet + face; equal faces lie side by side.
pub(crate) fn sorted_faces(tets: &[[u32; 4]]) -> Vec<([u32; 3], u32)> {
    let mut faces = Vec::with_capacity(tets.len() * 4);
    for (t, tet) in tets.iter().enumerate() {
        for f in 0..4 {
            let mut key = face(tet, f);
            key.sort_unstable();
            faces.push((key, (4 * t + f) as u32));
        }
    }
    faces.sort_unstable();
    faces
}
