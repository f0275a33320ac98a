//! Local digital topology: 3×3×3 neighbourhoods as 27 bits (x + 3·y + 9·z, the centre is bit 13).
//!
//! The inside is connected by faces, the outside by faces and edges: the pair (6⁺, 18) of G. Bertrand (1994). It is
//! the topology of marching cubes that separates inside corners on ambiguous faces.

/// Connectivity of a set.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Adjacency {
    /// Faces, with the neighbourhood 6⁺.
    Inside,
    /// Faces and edges.
    Outside,
}

const ALL: u32 = (1 << 27) - 1;
const CENTRE: u32 = 1 << 13;

const fn slab(axis: usize, at: usize) -> u32 {
    let mut m = 0;
    let mut n = 0;
    while n < 27 {
        let c = [n % 3, n / 3 % 3, n / 9];
        if c[axis] == at {
            m |= 1 << n;
        }
        n += 1;
    }
    m
}

const NOT_LOW: [u32; 3] = [ALL & !slab(0, 0), ALL & !slab(1, 0), ALL & !slab(2, 0)];
const NOT_HIGH: [u32; 3] = [ALL & !slab(0, 2), ALL & !slab(1, 2), ALL & !slab(2, 2)];
const FACES: u32 = 1 << 12 | 1 << 14 | 1 << 10 | 1 << 16 | 1 << 4 | 1 << 22;
const CORNERS: u32 = 1 | 1 << 2 | 1 << 6 | 1 << 8 | 1 << 18 | 1 << 20 | 1 << 24 | 1 << 26;
const FACES_AND_EDGES: u32 = ALL & !CORNERS & !CENTRE;

/// Neighbours along one axis.
const fn along(m: u32, axis: usize) -> u32 {
    let s = [1, 3, 9][axis];
    (m & NOT_HIGH[axis]) << s | (m & NOT_LOW[axis]) >> s
}

const fn grow(m: u32, adjacency: Adjacency) -> u32 {
    match adjacency {
        Adjacency::Inside => m | along(m, 0) | along(m, 1) | along(m, 2),
        Adjacency::Outside => {
            let x = m | along(m, 0);
            let y = m | along(m, 1);
            x | along(x, 1) | along(x, 2) | y | along(y, 2)
        }
    }
}

/// Parts of a set around the centre that touch it: their number and one neighbour of each (a bit number, by which
/// the part is adjacent to the centre).
pub(crate) fn parts(set: u32, adjacency: Adjacency) -> (usize, [u8; 8]) {
    let set = set & !CENTRE;
    let (touching, reach) = match adjacency {
        Adjacency::Inside => (FACES, 2),
        Adjacency::Outside => (FACES_AND_EDGES, 1),
    };
    let seeds = set & touching;
    // Geodesic neighbourhood: what is reached from the touching neighbours in so many steps.
    let mut near = seeds;
    for _ in 0..reach {
        near |= grow(near, adjacency) & set;
    }
    let mut rest = seeds;
    let (mut count, mut of) = (0, [0; 8]);
    while rest != 0 {
        let mut part = rest & rest.wrapping_neg();
        if count < 8 {
            of[count] = part.trailing_zeros() as u8;
        }
        loop {
            let next = grow(part, adjacency) & near;
            if next == part {
                break;
            }
            part = next;
        }
        count += 1;
        rest &= !part;
    }
    (count, of)
}

/// Eight times the share of a cell in the Euler number of the body; corner bits are x + 2y + 4z.
///
/// Vertices − edges + squares − cubes counts the inside joined by faces. A cell with two opposite corners outside is
/// filled as well, because the outside does not connect over a cell's diagonal.
pub(crate) const fn cell_euler(corners: u8) -> i32 {
    let c = corners as usize;
    let mut sum = corners.count_ones() as i32;
    let mut n = 0;
    while n < 8 {
        let mut a = 0;
        while a < 3 {
            let m = n | 1 << a;
            if n & (1 << a) == 0 && has_bit(c, n) && has_bit(c, m) {
                sum -= 2;
            }
            // The square at n that spans the other two axes.
            let (b, d) = ((a + 1) % 3, (a + 2) % 3);
            if n & (1 << b) == 0
                && n & (1 << d) == 0
                && has_bit(c, n)
                && has_bit(c, n | 1 << b)
                && has_bit(c, n | 1 << d)
                && has_bit(c, n | 1 << b | 1 << d)
            {
                sum += 4;
            }
            a += 1;
        }
        n += 1;
    }
    if c == 255 {
        sum -= 8;
    }
    let out = !c & 255;
    if out == 0b1000_0001 || out == 0b0100_0010 || out == 0b0010_0100 || out == 0b0001_1000 {
        sum += 8;
    }
    sum
}

const fn has_bit(c: usize, n: usize) -> bool {
    c >> n & 1 == 1
}

/// [`cell_euler`] of all cells.
pub(crate) const CELL_EULER: [i32; 256] = {
    let mut t = [0; 256];
    let mut n = 0;
    while n < 256 {
        t[n] = cell_euler(n as u8);
        n += 1;
    }
    t
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_of_small_sets() {
        let bit = |x: u32, y: u32, z: u32| 1u32 << (x + 3 * y + 9 * z);
        let inside = |m| parts(m, Adjacency::Inside).0;
        let outside = |m| parts(m, Adjacency::Outside).0;
        assert_eq!((inside(0), outside(0)), (0, 0));
        assert_eq!((inside(ALL), outside(ALL)), (1, 1));
        // Two opposite faces.
        let m = bit(0, 1, 1) | bit(2, 1, 1);
        assert_eq!((inside(m), outside(m)), (2, 2));
        // Two faces that share an edge: apart by faces, together by edges; with the edge voxel together by both.
        let m = bit(0, 1, 1) | bit(1, 0, 1);
        assert_eq!((inside(m), outside(m)), (2, 1));
        assert_eq!(inside(m | bit(0, 0, 1)), 1);
        // An edge neighbour alone touches by edges only, a corner by nothing.
        assert_eq!((inside(bit(0, 0, 1)), outside(bit(0, 0, 1))), (0, 1));
        assert_eq!((inside(bit(0, 0, 0)), outside(bit(0, 0, 0))), (0, 0));
    }

    /// Euler number of the iso-surface of a cell by its definition: cut edges are vertices (shared by four cells),
    /// segments on faces are edges (shared by two), each closed loop of segments is a disc.
    fn surface_share(c: u8) -> f64 {
        let has = |n: usize| c >> n & 1 == 1;
        let edge = |p: usize, q: usize| (p.min(q), p.max(q));
        let mut segments = Vec::new();
        for a in 0..3 {
            let (b, d) = ((a + 1) % 3, (a + 2) % 3);
            for side in 0..2 {
                let base = side << a;
                let ring = [base, base | 1 << b, base | 1 << b | 1 << d, base | 1 << d];
                let cuts: Vec<_> = (0..4)
                    .map(|n| (ring[n], ring[(n + 1) % 4]))
                    .filter(|&(p, q)| has(p) != has(q))
                    .map(|(p, q)| edge(p, q))
                    .collect();
                if cuts.len() == 2 {
                    segments.push((cuts[0], cuts[1]));
                } else if cuts.len() == 4 {
                    for n in 0..4 {
                        if has(ring[n]) {
                            segments
                                .push((edge(ring[(n + 3) % 4], ring[n]), edge(ring[n], ring[(n + 1) % 4])));
                        }
                    }
                }
            }
        }
        let mut vertices: Vec<_> = segments.iter().flat_map(|s| [s.0, s.1]).collect();
        vertices.sort_unstable();
        vertices.dedup();
        let mut loops = 0;
        let mut rest = segments.clone();
        while let Some(first) = rest.pop() {
            let mut end = first.1;
            while end != first.0 {
                let n = rest.iter().position(|s| s.0 == end || s.1 == end).unwrap();
                let s = rest.swap_remove(n);
                end = if s.0 == end { s.1 } else { s.0 };
            }
            loops += 1;
        }
        vertices.len() as f64 / 4.0 - segments.len() as f64 / 2.0 + f64::from(loops)
    }

    #[test]
    fn euler_number_is_that_of_the_iso_surface() {
        let mut state = 1u64;
        for density in [2u64, 3, 5, 8] {
            let n = 14;
            let v: Vec<bool> = (0..n * n * n)
                .map(|m| {
                    state = state
                        .wrapping_mul(6364136223846793005)
                        .wrapping_add(1442695040888963407);
                    let c = [m % n, m / n % n, m / (n * n)];
                    c.iter().all(|&x| x > 0 && x < n - 1) && !(state >> 33).is_multiple_of(density)
                })
                .collect();
            let (mut body, mut surface) = (0, 0.0);
            for k in 0..n - 1 {
                for j in 0..n - 1 {
                    for i in 0..n - 1 {
                        let c = (0..8).fold(0u8, |c, b| {
                            let at = i + (b & 1) + n * (j + (b >> 1 & 1) + n * (k + (b >> 2)));
                            c | u8::from(v[at]) << b
                        });
                        body += CELL_EULER[c as usize];
                        surface += surface_share(c);
                    }
                }
            }
            assert_eq!(f64::from(body) / 4.0, surface, "density {density}");
        }
    }
}
