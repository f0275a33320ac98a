//! Reverse Cuthill–McKee numbering: neighbours in the mesh become neighbours in memory (Chentanez et al. 2009, section 3.6.2).

/// Node order (old index by new place) for the graph of tet edges; every component in turn, lone nodes included.
pub fn reverse_cuthill_mckee(nodes: usize, tets: &[[u32; 4]]) -> Vec<u32> {
    let mut pairs: Vec<(u32, u32)> = tets
        .iter()
        .flat_map(|t| (0..4).flat_map(move |i| (0..4).filter(move |&j| j != i).map(move |j| (t[i], t[j]))))
        .collect();
    pairs.sort_unstable();
    pairs.dedup();
    order_graph(nodes, &pairs)
}

/// The same for a symmetric list of directed edges, sorted and without doubles.
fn order_graph(nodes: usize, pairs: &[(u32, u32)]) -> Vec<u32> {
    let mut start = vec![0usize; nodes + 1];
    for &(a, _) in pairs {
        start[a as usize + 1] += 1;
    }
    for n in 0..nodes {
        start[n + 1] += start[n];
    }
    let around = |n: u32| {
        pairs[start[n as usize]..start[n as usize + 1]]
            .iter()
            .map(|p| p.1)
    };
    let degree = |n: u32| start[n as usize + 1] - start[n as usize];
    let mut mark = vec![0u32; nodes];
    let mut round = 0;
    // Breadth-first layers from `root`: visit order, number of layers, least-degree node of the last.
    let mut layers = |root: u32| {
        round += 1;
        mark[root as usize] = round;
        let mut seen = vec![root];
        let (mut first, mut depth) = (0, 0);
        while first < seen.len() {
            let last = seen.len();
            depth += 1;
            for k in first..last {
                for m in around(seen[k]) {
                    if mark[m as usize] != round {
                        mark[m as usize] = round;
                        seen.push(m);
                    }
                }
            }
            if seen.len() == last {
                break;
            }
            first = last;
        }
        let far = seen[first..]
            .iter()
            .copied()
            .min_by_key(|&n| (degree(n), n))
            .unwrap_or(root);
        (depth, far)
    };
    let mut by_degree: Vec<u32> = (0..nodes as u32).collect();
    by_degree.sort_by_key(|&n| (degree(n), n));
    let mut order: Vec<u32> = Vec::with_capacity(nodes);
    let mut done = vec![false; nodes];
    for seed in by_degree {
        if done[seed as usize] {
            continue;
        }
        // A pseudo-peripheral root: move to the far end until the depth stops growing.
        let mut root = seed;
        let (mut depth, mut far) = layers(root);
        loop {
            let (d, f) = layers(far);
            if d <= depth {
                break;
            }
            (root, depth, far) = (far, d, f);
        }
        let mut next = order.len();
        order.push(root);
        done[root as usize] = true;
        while next < order.len() {
            let mut fresh: Vec<u32> = around(order[next]).filter(|&m| !done[m as usize]).collect();
            fresh.sort_by_key(|&m| (degree(m), m));
            for m in fresh {
                done[m as usize] = true;
                order.push(m);
            }
            next += 1;
        }
    }
    order.reverse();
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_becomes_a_band_of_one() {
        let path = [(0, 5), (5, 2), (2, 7), (7, 1), (1, 6), (6, 3), (3, 4)];
        let mut pairs: Vec<(u32, u32)> = path.iter().flat_map(|&(a, b)| [(a, b), (b, a)]).collect();
        pairs.sort_unstable();
        let order = order_graph(8, &pairs);
        let wanted = [4, 3, 6, 1, 7, 2, 5, 0];
        let mut back = wanted;
        back.reverse();
        assert!(order == wanted || order == back, "{order:?}");
    }

    #[test]
    fn every_node_comes_once_in_several_pieces() {
        let tets = [[0, 1, 2, 3], [4, 5, 6, 7], [3, 2, 1, 8]];
        let mut order = reverse_cuthill_mckee(11, &tets);
        order.sort_unstable();
        assert_eq!(order, (0..11).collect::<Vec<u32>>());
    }
}
