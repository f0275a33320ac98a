use kiddo::{ImmutableKdTree, SquaredEuclidean};
use serde::{Deserialize, Serialize};
use std::num::NonZero;

/// How points are tied to cluster frames.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SkinParams {
    /// Frames of a point, 1 to 4. The paper uses up to four.
    pub max_frames: usize,
    /// Exponent on the squared distance: 1 is the paper's inverse square, 2 its square.
    pub falloff: f64,
    /// Subtract the next frame's weight before normalising, so that weights change continuously over space where
    /// the last frame gives way to the next. Off: the paper's plain rule.
    pub remove_fifth: bool,
}

impl Default for SkinParams {
    fn default() -> Self {
        Self {
            max_frames: 4,
            falloff: 1.0,
            remove_fifth: false,
        }
    }
}

/// Frames and weights of each point. Unused slots have weight 0 and repeat the first index.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SkinWeights {
    /// Cluster indices, nearest first.
    pub indices: Vec<[u32; 4]>,
    /// Weights ≥ 0 with sum 1 (to f32 rounding).
    pub weights: Vec<[f32; 4]>,
}

/// What the binding looks like.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SkinReport {
    /// Points bound.
    pub points: usize,
    /// Clusters offered.
    pub clusters: usize,
    /// Clusters that some point uses.
    pub clusters_used: usize,
    /// Distance from a point to its nearest cluster centre: mean, mm.
    pub nearest_mean_mm: f64,
    /// Distance from a point to its nearest cluster centre: most, mm.
    pub nearest_max_mm: f64,
    /// Largest weight of a point: mean over the points.
    pub first_weight_mean: f64,
    /// Largest distance of a point from its place after skinning in f32 with all frames at rest, mm.
    pub rest_error_max_mm: f64,
}

/// Why points could not be bound.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SkinError {
    /// A parameter out of its range.
    #[error("skinning: {name} is {value}, expected {expected}")]
    Parameter {
        /// Field of `SkinParams`.
        name: &'static str,
        /// What was given.
        value: f64,
        /// What is allowed.
        expected: &'static str,
    },
    /// There are no clusters to bind to.
    #[error("skinning: {points} points but no clusters to bind them to")]
    NoClusters {
        /// Points to bind.
        points: usize,
    },
    /// A position that is NaN, infinite or beyond 1e7 mm.
    #[error("skinning: {what} {index} lies at {position:?} mm, expected finite coordinates below 1e7 mm")]
    BadPosition {
        /// `point` or `cluster centre`.
        what: &'static str,
        /// Its number.
        index: usize,
        /// Its position.
        position: [f64; 3],
    },
    /// The neighbour search refused the centres.
    #[error("skinning: no search tree over {clusters} cluster centres: {reason}")]
    Tree {
        /// Number of centres.
        clusters: usize,
        /// What the tree said.
        reason: String,
    },
}

/// Ties each point (patient RAS mm) to the nearest cluster frames with weights 1/(d²ᵖ + ε), normalised (Camara et al.
/// 2016, "Weighted matrix blending"). ε is (1e-6 · mean distance of neighbouring centres)²ᵖ: it only keeps a point
/// on a centre finite. Clusters at the same distance are taken by index.
///
/// # Errors
/// [`SkinError`]: parameters out of range, no clusters, non-finite positions.
pub fn bind(
    points: &[[f64; 3]],
    centres: &[[f64; 3]],
    params: &SkinParams,
) -> Result<(SkinWeights, SkinReport), SkinError> {
    let frames = params.max_frames;
    if !(1..=4).contains(&frames) {
        return Err(SkinError::Parameter {
            name: "max_frames",
            value: frames as f64,
            expected: "1 to 4",
        });
    }
    if !(params.falloff >= 0.25 && params.falloff <= 8.0) {
        return Err(SkinError::Parameter {
            name: "falloff",
            value: params.falloff,
            expected: "0.25 to 8",
        });
    }
    check("point", points)?;
    check("cluster centre", centres)?;
    if centres.is_empty() {
        return Err(SkinError::NoClusters { points: points.len() });
    }
    let tree = tree_of(centres)?;
    let spacing = mean_spacing(centres, &tree);
    let epsilon = (1e-6 * spacing).powf(2.0 * params.falloff);
    let mut out = SkinWeights::default();
    let mut used = vec![false; centres.len()];
    let mut report = SkinReport {
        points: points.len(),
        clusters: centres.len(),
        clusters_used: 0,
        nearest_mean_mm: 0.0,
        nearest_max_mm: 0.0,
        first_weight_mean: 0.0,
        rest_error_max_mm: 0.0,
    };
    for &p in points {
        let near = nearest(&tree, centres, p, frames + usize::from(params.remove_fifth));
        let d2: Vec<f64> = near.iter().map(|n| n.0).collect();
        let weights = frame_weights(&d2, frames, params.falloff, epsilon);
        let mut index = [near[0].1; 4];
        for (slot, n) in index.iter_mut().zip(&near).take(frames) {
            *slot = n.1;
            used[n.1 as usize] = true;
        }
        let d = d2[0].sqrt();
        report.nearest_mean_mm += d / points.len() as f64;
        report.nearest_max_mm = report.nearest_max_mm.max(d);
        report.first_weight_mean += weights[0] / points.len() as f64;
        out.indices.push(index);
        out.weights.push(weights.map(|w| w as f32));
    }
    report.clusters_used = used.iter().filter(|u| **u).count();
    report.rest_error_max_mm = rest_error(points, centres, &out);
    Ok((out, report))
}

/// How many points have their nearest member of their first cluster farther than `distance_mm`: points that hang on
/// a cluster across a gap. `offsets` and `members` are the clusters' lists, `positions` the particles.
pub fn points_far_from_members(
    points: &[[f64; 3]],
    weights: &SkinWeights,
    offsets: &[u32],
    members: &[u32],
    positions: &[[f64; 3]],
    distance_mm: f64,
) -> usize {
    let list = |c: u32| {
        let (from, to) = (offsets.get(c as usize), offsets.get(c as usize + 1));
        from.zip(to)
            .and_then(|(&a, &b)| members.get(a as usize..b as usize))
            .unwrap_or(&[])
    };
    let far = |(p, index): (&[f64; 3], &[u32; 4])| {
        !list(index[0])
            .iter()
            .filter_map(|&m| positions.get(m as usize))
            .any(|q| squared(*p, *q) <= distance_mm * distance_mm)
    };
    points
        .iter()
        .zip(&weights.indices)
        .filter(|&pair| far(pair))
        .count()
}

type Tree = ImmutableKdTree<f64, 3>;

fn tree_of(centres: &[[f64; 3]]) -> Result<Tree, SkinError> {
    Tree::new_from_slice(centres).map_err(|e| SkinError::Tree {
        clusters: centres.len(),
        reason: format!("{e:?}"),
    })
}

fn check(what: &'static str, positions: &[[f64; 3]]) -> Result<(), SkinError> {
    match positions.iter().position(|p| !p.iter().all(|c| c.abs() < 1e7)) {
        Some(index) => Err(SkinError::BadPosition {
            what,
            index,
            position: positions[index],
        }),
        None => Ok(()),
    }
}

fn squared(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|k| (a[k] - b[k]).powi(2)).sum()
}

/// Squared distance and index of the `count` nearest centres, by distance and then index.
fn nearest(tree: &Tree, centres: &[[f64; 3]], p: [f64; 3], count: usize) -> Vec<(f64, u32)> {
    let count = NonZero::new(count.min(centres.len())).unwrap_or(NonZero::<usize>::MIN);
    let first = tree.query(&p).nearest_n::<SquaredEuclidean<f64>>(count).execute();
    // Among equals at the edge the tree's choice is arbitrary: ask again for all up to that distance.
    let reach = first.iter().map(|n| n.distance).fold(0.0, f64::max) * (1.0 + 1e-12);
    let all = tree.query(&p).within::<SquaredEuclidean<f64>>(reach).execute();
    let mut out: Vec<(f64, u32)> = all
        .iter()
        .map(|n| (squared(p, centres[n.item as usize]), n.item))
        .collect();
    out.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    out.truncate(count.get());
    out
}

/// Mean distance from a centre to its nearest other, mm; 1 where there is none.
fn mean_spacing(centres: &[[f64; 3]], tree: &Tree) -> f64 {
    let sum: f64 = centres
        .iter()
        .map(|&c| nearest(tree, centres, c, 2).last().map_or(0.0, |n| n.0.sqrt()))
        .sum();
    let mean = sum / centres.len() as f64;
    if mean > 0.0 { mean } else { 1.0 }
}

/// Normalised weights of the first `frames` squared distances; where one more is given its raw weight is taken off
/// the others first.
pub(crate) fn frame_weights(d2: &[f64], frames: usize, falloff: f64, epsilon: f64) -> [f64; 4] {
    let raw = |d2: &f64| 1.0 / (d2.powf(falloff) + epsilon);
    let mut out = [0.0; 4];
    for (w, d) in out.iter_mut().zip(&d2[..d2.len().min(frames)]) {
        *w = raw(d);
    }
    if let Some(next) = d2.get(frames).map(raw) {
        // All equal to the next: nothing would be left.
        if out[0] > next * (1.0 + 1e-9) {
            for w in &mut out {
                *w = (*w - next).max(0.0);
            }
        }
    }
    let sum: f64 = out.iter().sum();
    out.map(|w| w / sum)
}

/// Largest error of the f32 blend with all frames at rest.
fn rest_error(points: &[[f64; 3]], centres: &[[f64; 3]], weights: &SkinWeights) -> f64 {
    let narrow = |v: &[[f64; 3]]| v.iter().map(|p| p.map(|c| c as f32)).collect::<Vec<_>>();
    let (points32, centres32) = (narrow(points), narrow(centres));
    let still = vec![glam::Quat::IDENTITY; centres.len()];
    let at: Vec<glam::Vec3> = centres32.iter().map(|&c| c.into()).collect();
    crate::deform_f32(&points32, weights, &centres32, &still, &at)
        .iter()
        .zip(points)
        .map(|(p, q)| squared(p.map(f64::from), *q))
        .fold(0.0, f64::max)
        .sqrt()
}
