//! Frames along a curve: parallel transport, Bishop frames, angles (Bergou et al. 2008, §4.2).

use glam::{DQuat, DVec3};

/// Orthonormal frame of an edge: tangent and two material directions of the cross-section, `m1 × m2 = tangent`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MaterialFrame {
    /// Unit tangent, from base to tip.
    pub tangent: DVec3,
    /// First material direction.
    pub m1: DVec3,
    /// Second material direction; a bevel pushes the tip this way (Chentanez et al. 2009, §3.5).
    pub m2: DVec3,
}

/// Parallel transport of `u` from unit vector `from` to unit vector `to`: the least rotation that takes one to the other.
/// Where they are opposite that rotation is not unique; then it is the half turn about an axis across `from` that
/// depends on `from` alone.
pub fn transport(u: DVec3, from: DVec3, to: DVec3) -> DVec3 {
    let cosine = from.dot(to);
    let binormal = from.cross(to);
    if 1.0 + cosine < 1e-12 {
        let axis = from.any_orthonormal_vector();
        return 2.0 * axis.dot(u) * axis - u;
    }
    cosine * u + binormal.cross(u) + binormal * (binormal.dot(u) / (1.0 + cosine))
}

/// Unit vector nearest to `u` across `tangent`; any such where `u` is along it.
pub(crate) fn across(u: DVec3, tangent: DVec3) -> DVec3 {
    (u - tangent * u.dot(tangent))
        .try_normalize()
        .unwrap_or_else(|| tangent.any_orthonormal_vector())
}

/// Bishop (twist-free) directors of edges with the given unit tangents, the first being `director` made orthonormal.
pub(crate) fn bishop(tangents: &[DVec3], director: DVec3) -> Vec<DVec3> {
    let mut directors = Vec::with_capacity(tangents.len());
    let mut u = director;
    for (j, &tangent) in tangents.iter().enumerate() {
        if j > 0 {
            u = transport(u, tangents[j - 1], tangent);
        }
        u = across(u, tangent);
        directors.push(u);
    }
    directors
}

/// Angle from `a` to `b` about `tangent`, in (−π, π].
pub(crate) fn angle_about(tangent: DVec3, a: DVec3, b: DVec3) -> f64 {
    a.cross(b).dot(tangent).atan2(a.dot(b))
}

/// `angle` plus the multiple of 2π that brings it nearest to `reference`.
pub(crate) fn unwrap_near(angle: f64, reference: f64) -> f64 {
    use std::f64::consts::TAU;
    angle + TAU * ((reference - angle) / TAU).round()
}

/// Material frame at angle `theta` from Bishop director `u`.
pub(crate) fn material(tangent: DVec3, u: DVec3, theta: f64) -> MaterialFrame {
    let v = tangent.cross(u);
    let (sine, cosine) = theta.sin_cos();
    MaterialFrame {
        tangent,
        m1: cosine * u + sine * v,
        m2: cosine * v - sine * u,
    }
}

/// Rotation of a body that turns with constant `angular_velocity` (rad/s, world axes) for `dt` seconds.
pub(crate) fn rotation_over(angular_velocity: DVec3, dt: f64) -> DQuat {
    DQuat::from_scaled_axis(angular_velocity * dt)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn transport_turns_one_tangent_into_the_other_and_keeps_lengths() {
        let from = DVec3::new(1.0, 2.0, -0.5).normalize();
        for to in [
            DVec3::new(-0.3, 0.4, 0.9).normalize(),
            from,
            -from,
            -(from + 1e-9 * DVec3::X).normalize(),
        ] {
            assert!((transport(from, from, to) - to).length() < 1e-6, "{to}");
            let u = DVec3::new(0.3, -1.0, 2.0);
            assert!((transport(u, from, to).length() - u.length()).abs() < 1e-6);
        }
        // The axis of the least rotation stays where it is.
        let to = DVec3::new(-0.3, 0.4, 0.9).normalize();
        let axis = from.cross(to);
        assert!((transport(axis, from, to) - axis).length() < 1e-14);
    }

    #[test]
    fn holonomy_of_an_octant_is_its_solid_angle() {
        let corners = [DVec3::X, DVec3::Y, DVec3::Z, DVec3::X];
        let mut u = DVec3::Y;
        for pair in corners.windows(2) {
            u = transport(u, pair[0], pair[1]);
        }
        assert!((angle_about(DVec3::X, DVec3::Y, u) - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
    }
}
