/// Edits (insert, delete, replace, swap of neighbours) that turn one text into the other, case ignored.
pub(crate) fn edit_distance(a: &str, b: &str) -> usize {
    let a: Vec<char> = a.to_lowercase().chars().collect();
    let b: Vec<char> = b.to_lowercase().chars().collect();
    let mut rows = vec![vec![0usize; b.len() + 1]; a.len() + 1];
    for (j, cell) in rows[0].iter_mut().enumerate() {
        *cell = j;
    }
    for i in 1..=a.len() {
        rows[i][0] = i;
        for j in 1..=b.len() {
            let replace = rows[i - 1][j - 1] + usize::from(a[i - 1] != b[j - 1]);
            let mut best = replace.min(rows[i - 1][j] + 1).min(rows[i][j - 1] + 1);
            if i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1] {
                best = best.min(rows[i - 2][j - 2] + 1);
            }
            rows[i][j] = best;
        }
    }
    rows[a.len()][b.len()]
}

/// Endings that say a unit, as keys of a scene carry them.
const UNITS: [&str; 23] = [
    "_kg_m3", "_g_cm3", "_g_mm3", "_kpa", "_mpa", "_gpa", "_pa", "_mm_s2", "_m_s2", "_mm", "_cm", "_m",
    "_um", "_in", "_s", "_ms", "_deg", "_rad", "_mhz", "_khz", "_hz", "_px", "_db",
];

/// The key without its unit, and the unit.
fn split_unit(key: &str) -> (&str, &str) {
    UNITS
        .iter()
        .find_map(|u| key.strip_suffix(u).map(|stem| (stem, *u)))
        .unwrap_or((key, ""))
}

/// The known name nearest to `found`: one that differs in its unit alone goes first, then the fewest edits, then the
/// order given. None where nothing is near (more than half of the letters differ).
pub(crate) fn nearest<'a>(found: &str, known: &[&'a str]) -> Option<&'a str> {
    let stem = split_unit(found).0;
    if let Some(&k) = known.iter().find(|k| split_unit(k).0 == stem) {
        return Some(k);
    }
    known
        .iter()
        .map(|&k| (edit_distance(found, k), k))
        .min_by_key(|&(d, _)| d)
        .filter(|&(d, k)| 2 * d <= found.chars().count().max(k.chars().count()))
        .map(|(_, k)| k)
}

/// Whether the two keys say the same quantity in different units.
pub(crate) fn differ_in_unit(a: &str, b: &str) -> bool {
    let (a, b) = (split_unit(a), split_unit(b));
    a.0 == b.0 && a.1 != b.1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_by_hand() {
        for (a, b, d) in [
            ("", "abc", 3),
            ("size_mm", "size_mm", 0),
            ("szie_mm", "size_mm", 1),
            ("sise_mm", "size_mm", 1),
            ("Size_mm", "size_mm", 0),
            ("kitten", "sitting", 3),
        ] {
            assert_eq!(edit_distance(a, b), d, "{a} {b}");
        }
    }

    #[test]
    fn a_wrong_unit_is_nearer_than_a_near_name() {
        let known = ["depth_mm", "deph_cx", "width_mm"];
        assert_eq!(nearest("depth_cm", &known), Some("depth_mm"));
        assert_eq!(nearest("depth", &known), Some("depth_mm"));
        assert!(differ_in_unit("depth_cm", "depth_mm") && !differ_in_unit("depth_mm", "depth_mm"));
        assert_eq!(nearest("widht_mm", &known), Some("width_mm"));
        assert_eq!(nearest("zebra", &known), None);
    }
}
