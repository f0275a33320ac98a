//! Constitutive laws: energy, first Piola–Kirchhoff stress, and their description in principal stretches.
//!
//! Units: Pa = g/(mm·s²), densities g/mm³, times s.

use crate::FemError;
use crate::rotation::{Svd, rotation};
use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// Stress–strain law of a material. F is the deformation gradient, J = det F, R = U·Vᵀ its rotation part, s its
/// principal stretches (F = U·diag(s)·Vᵀ, Irving et al. 2004), µ and λ the Lamé constants.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Law {
    /// Hooke's law on the small strain (F + Fᵀ)/2 − I: wrong for large rotations, exact for beam theory.
    Linear,
    /// Hooke's law on s − 1 in the frame of the singular value decomposition, as in Irving et al. 2004 and
    /// Chentanez et al. 2009, section 3.2.
    RotatedLinear,
    /// The same law with R found directly: P = R·(2µ(sym(RᵀF) − I) + λ·tr(RᵀF − I)·I). Equal to
    /// [`Law::RotatedLinear`], for inverted tets too, and several times faster.
    #[default]
    Corotated,
    /// W = µ/2·(F:F − 3 − 2·ln J) + λ/2·(ln J)², continued below J = [`LEAST_VOLUME_RATIO`] by the parabola of equal
    /// value, slope and curvature in J, so that flat and inverted tets push back with finite force.
    NeoHookean,
    /// Smith, de Goes, Kim 2018 without their origin barrier: µ/2·(F:F − 3) − µ(J − 1) + (λ+µ)/2·(J − 1)².
    StableNeoHookean,
    /// Stiffens exponentially (Demiray 1972; for J = 1 his W = µ/(2b)·(exp(b(F:F − 3)) − 1)), with the volumetric part of the stable
    /// neo-Hookean law: W = µ/(2b)·(exp(b·q) − 1) + λ/2·(J − 1)², q = F:F − 3 − 2(J − 1) + (J − 1)². q is at least 0 for any F, quadratic
    /// at small strain, so that µ and λ are Hooke's there, and b → 0 is [`Law::StableNeoHookean`]. Beyond b·q = [`GREATEST_EXPONENT`]
    /// the exponential is continued by its parabola in q: flat and inverted tets push back with finite force.
    Demiray,
}

/// Exponent beyond which [`Law::Demiray`] is continued by a parabola: some 150 times the shear modulus at rest, far past where tissue tears,
/// and no harder than one Newton iteration of a step can follow.
pub const GREATEST_EXPONENT: f64 = 5.0;

/// Volume ratio below which [`Law::NeoHookean`] is continued: a tet has lost three quarters of its volume, which tissue never
/// does, and the continuation is not yet so stiff that an inverted tet comes back like an explosion.
pub const LEAST_VOLUME_RATIO: f64 = 0.25;

/// Constants of a law.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Moduli {
    /// Shear modulus µ at small strain, Pa.
    pub mu_pa: f64,
    /// Lamé's λ, Pa.
    pub lambda_pa: f64,
    /// b of [`Law::Demiray`]; of no effect in the others.
    pub stiffening: f64,
}

/// One tissue.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Material {
    /// Stress–strain law. Corotated: the paper's law, the fastest.
    pub law: Law,
    /// Young's modulus, Pa. 5000: kidney cortex (see [`crate::TissueTable`]).
    pub youngs_modulus_pa: f64,
    /// Poisson's ratio, 0 to below 0.5. 0.45: nearly incompressible, yet linear tets do not lock.
    pub poisson_ratio: f64,
    /// b of [`Law::Demiray`], above 0: how soon the tissue stiffens. A bar of that law that is stretched or pressed to the length s times
    /// its own is about exp(b(s² + 2/s − 3)) times as stiff in shear as at rest. 8: nominal (see [`crate::TissueTable`]).
    pub stiffening: f64,
    /// Density, g/mm³. 1.05e-3: kidney.
    pub density_g_mm3: f64,
    /// r, s: the damping stress is the law of [`Law::Corotated`] with r·µ and r·λ on the strain rate. 0.02: vibrations of
    /// an organ (some 10 Hz) die within a few swings, as the paper's hand-tuned damping lets them.
    pub damping_s: f64,
}

impl Default for Material {
    fn default() -> Self {
        Self {
            law: Law::Corotated,
            youngs_modulus_pa: 5000.0,
            poisson_ratio: 0.45,
            stiffening: 8.0,
            density_g_mm3: 1.05e-3,
            damping_s: 0.02,
        }
    }
}

impl Material {
    /// Constants of the law: Lamé's from Young's modulus and Poisson's ratio.
    pub fn moduli(&self) -> Moduli {
        let (e, nu) = (self.youngs_modulus_pa, self.poisson_ratio);
        Moduli {
            mu_pa: e / (2.0 * (1.0 + nu)),
            lambda_pa: e * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)),
            stiffening: self.stiffening,
        }
    }

    /// Refuses what cannot be simulated and returns warnings about what hardly can be meant.
    ///
    /// # Errors
    /// [`FemError::Value`] for a modulus, stiffening or density of zero or below, a Poisson ratio outside 0 to 0.5, a stiffening above
    /// 1000, a negative damping, or anything that is no finite number.
    pub fn check(&self, name: &str) -> Result<Vec<String>, FemError> {
        let field = |field: &'static str, v: f64, fine: bool, expected: &'static str| {
            if fine && v.is_finite() {
                Ok(())
            } else {
                Err(FemError::Value {
                    of: format!("material {name}"),
                    name: field,
                    found: v,
                    expected,
                })
            }
        };
        let (e, nu, b, rho, r) = (
            self.youngs_modulus_pa,
            self.poisson_ratio,
            self.stiffening,
            self.density_g_mm3,
            self.damping_s,
        );
        field("youngs_modulus_pa", e, e > 0.0, "a modulus above 0 Pa")?;
        field(
            "poisson_ratio",
            nu,
            (0.0..0.5).contains(&nu),
            "0 or more and below 0.5",
        )?;
        field("stiffening", b, b > 0.0 && b <= 1000.0, "above 0, at most 1000")?;
        field("density_g_mm3", rho, rho > 0.0, "a density above 0 g/mm³")?;
        field("damping_s", r, r >= 0.0, "0 s or more")?;
        let mut warnings = Vec::new();
        if e < 100.0 {
            warnings.push(format!(
                "material {name}: a Young's modulus of {e} Pa is softer than any tissue; was {} Pa (that many kPa) meant?",
                e * 1000.0
            ));
        }
        if e > 1e9 {
            warnings.push(format!(
                "material {name}: a Young's modulus of {e:e} Pa is bone; hold its nodes instead of simulating it"
            ));
        }
        if nu > 0.49 {
            warnings.push(format!(
                "material {name}: linear tets lock at a Poisson ratio of {nu}; 0.45 to 0.49 is as incompressible as they get"
            ));
        }
        if self.law == Law::Demiray && b > 50.0 {
            warnings.push(format!(
                "material {name}: with a stiffening of {b} tissue is rigid beyond a strain of some {:.0} %; organs have 1 to 20",
                100.0 * (1.0 / b).sqrt()
            ));
        }
        if !(1e-4..1e-2).contains(&rho) {
            warnings.push(format!(
                "material {name}: a density of {rho} g/mm³ is not that of a tissue (water has 1e-3); was {rho} kg/m³ or g/cm³ meant?"
            ));
        }
        if r > 1.0 {
            warnings.push(format!(
                "material {name}: a damping of {r} s makes the tissue creep like putty; some 0.02 s is usual"
            ));
        }
        Ok(warnings)
    }
}

/// Energy per rest volume of a law of I₁ = F:F and J, and what makes up its stress P = mu·F + slope·cof F and its derivative.
struct Invariants {
    energy: f64,
    mu: f64,
    slope: f64,
    /// δP's part along cof F of δJ.
    curve: f64,
    /// δP's part along G = F + (J − 2)·cof F of G:δF: the stiffening of [`Law::Demiray`], 0 in the others.
    stiffening: f64,
}

impl Invariants {
    fn new(law: Law, m: Moduli, squares: f64, j: f64) -> Self {
        let (mu, lambda) = (m.mu_pa, m.lambda_pa);
        let d = j - 1.0;
        match law {
            Law::NeoHookean => {
                let j0 = j.max(LEAST_VOLUME_RATIO);
                let ln = j0.ln();
                let value = -mu * ln + 0.5 * lambda * ln * ln;
                let slope = (lambda * ln - mu) / j0;
                let curve = (lambda * (1.0 - ln) + mu) / (j0 * j0);
                let d = j - j0;
                Self {
                    energy: 0.5 * mu * (squares - 3.0) + value + d * (slope + 0.5 * curve * d),
                    mu,
                    slope: slope + curve * d,
                    curve,
                    stiffening: 0.0,
                }
            }
            Law::Demiray => {
                let b = m.stiffening;
                // The least value of q is 0; rounding may go below.
                let q = (squares - 3.0 + d * (d - 2.0)).max(0.0);
                let joint = q.min(GREATEST_EXPONENT / b);
                let grown = (b * joint).exp();
                let past = q - joint;
                let value = (b * joint).exp_m1() / b + past * grown * (1.0 + 0.5 * b * past);
                let mu_now = mu * grown * (1.0 + b * past);
                Self {
                    energy: 0.5 * mu * value + 0.5 * lambda * d * d,
                    mu: mu_now,
                    slope: mu_now * (d - 1.0) + lambda * d,
                    curve: mu_now + lambda,
                    stiffening: 2.0 * mu * b * grown,
                }
            }
            _ => {
                let k = lambda + mu;
                Self {
                    energy: 0.5 * mu * (squares - 3.0) - mu * d + 0.5 * k * d * d,
                    mu,
                    slope: k * d - mu,
                    curve: k,
                    stiffening: 0.0,
                }
            }
        }
    }
}

fn squares(f: DMat3) -> f64 {
    f.to_cols_array().iter().map(|x| x * x).sum()
}

pub(crate) fn cofactor(f: DMat3) -> DMat3 {
    DMat3::from_cols(
        f.y_axis.cross(f.z_axis),
        f.z_axis.cross(f.x_axis),
        f.x_axis.cross(f.y_axis),
    )
}

fn trace(m: DMat3) -> f64 {
    m.x_axis.x + m.y_axis.y + m.z_axis.z
}

/// Hooke's law 2µ·sym(e) + λ·tr(e)·I.
pub(crate) fn hooke(lame: Moduli, e: DMat3) -> DMat3 {
    (e + e.transpose()) * lame.mu_pa + DMat3::from_diagonal(DVec3::splat(lame.lambda_pa * trace(e)))
}

impl Law {
    /// Whether stress depends on I₁ and J, not on R: such laws take the singular value decomposition for their Jacobian.
    pub(crate) fn is_of_invariants(self) -> bool {
        matches!(self, Self::NeoHookean | Self::StableNeoHookean | Self::Demiray)
    }

    /// Strain energy per rest volume, Pa (times mm³: nJ).
    pub fn energy_density(self, lame: Moduli, f: DMat3) -> f64 {
        let quadratic = |e: DMat3| {
            let sym = (e + e.transpose()) * 0.5;
            let squares: f64 = sym.to_cols_array().iter().map(|x| x * x).sum();
            lame.mu_pa * squares + 0.5 * lame.lambda_pa * trace(e) * trace(e)
        };
        match self {
            Self::Linear => quadratic(f - DMat3::IDENTITY),
            Self::RotatedLinear | Self::Corotated => quadratic(rotation(f).transpose() * f - DMat3::IDENTITY),
            _ => Invariants::new(self, lame, squares(f), f.determinant()).energy,
        }
    }

    /// First Piola–Kirchhoff stress, Pa.
    pub fn stress(self, lame: Moduli, f: DMat3) -> DMat3 {
        match self {
            Self::Linear => hooke(lame, f - DMat3::IDENTITY),
            Self::RotatedLinear => {
                let d = crate::rotation::svd(f);
                d.u * DMat3::from_diagonal(self.principal_stress(lame, d.s)) * d.v.transpose()
            }
            Self::Corotated => {
                let r = rotation(f);
                r * hooke(lame, r.transpose() * f - DMat3::IDENTITY)
            }
            _ => {
                let i = Invariants::new(self, lame, squares(f), f.determinant());
                f * i.mu + cofactor(f) * i.slope
            }
        }
    }

    /// Diagonal of the stress in the principal frame, Pa, for stretches `s` (signed as in [`Svd`]). For
    /// [`Law::Linear`] this holds without rotation only.
    pub fn principal_stress(self, lame: Moduli, s: DVec3) -> DVec3 {
        match self {
            Self::Linear | Self::RotatedLinear | Self::Corotated => {
                (s - 1.0) * (2.0 * lame.mu_pa) + lame.lambda_pa * (s.element_sum() - 3.0)
            }
            _ => {
                let i = Invariants::new(self, lame, s.length_squared(), s.x * s.y * s.z);
                s * i.mu + DVec3::new(s.y * s.z, s.x * s.z, s.x * s.y) * i.slope
            }
        }
    }
}

/// Kelvin–Voigt damping stress in the rotated frame, Pa: R·(2rµ·sym(RᵀḞ) + rλ·tr(RᵀḞ)·I), the form of Irving et al. 2004
/// (its U·(…UᵀḞV…)·Vᵀ is the same), `rate` = Ḟ in 1/s.
pub fn damping_stress(lame: Moduli, damping_s: f64, rotation: DMat3, rate: DMat3) -> DMat3 {
    rotation * hooke(lame, rotation.transpose() * rate) * damping_s
}

/// Which derivative of the stress.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JacobianMode {
    /// The paper's: U and V (or R) held, so that turning a tet does not turn its stress. Positive semidefinite for
    /// Hooke's laws; of the others a simulation takes the positive part.
    #[default]
    Frozen,
    /// The derivative as it is; where the solver finds that the system is not positive definite, a simulation goes on with
    /// [`JacobianMode::ExactPositive`].
    Exact,
    /// The exact derivative with its negative eigenvalues set to zero (Teran et al. 2005, Smith et al. 2019).
    ExactPositive,
}

/// dP/dF in the principal frame: δP = U·N·Vᵀ where, for M = Uᵀ·δF·V, N has the diagonal `scale`·diag(M) and, for each pair
/// of axes, `flip` times the symmetric plus `twist` times the antisymmetric part of M.
#[derive(Clone, Copy, Debug)]
pub struct Tangent {
    /// Left rotation.
    pub u: DMat3,
    /// Right rotation.
    pub v: DMat3,
    /// ∂P̂ᵢ/∂sⱼ, Pa, symmetric.
    pub scale: DMat3,
    /// Eigenvalue of the symmetric mode of the axes (2,3), (3,1), (1,2), Pa.
    pub flip: DVec3,
    /// Eigenvalue of the antisymmetric mode of the same pairs, Pa.
    pub twist: DVec3,
}

/// Least |sᵢ + sⱼ| that a twist mode divides by: there the rotation of an inverted tet jumps.
const LEAST_SUM: f64 = 1e-9;

impl Tangent {
    /// Derivative of `law`'s stress at F (fem.md sections 3.1 and 3.2: Teran et al. 2005).
    pub fn new(law: Law, lame: Moduli, f: DMat3, mode: JacobianMode) -> Self {
        let (mu, lambda) = (lame.mu_pa, lame.lambda_pa);
        let hooke = DMat3::from_diagonal(DVec3::splat(2.0 * mu))
            + DMat3::from_cols(DVec3::splat(lambda), DVec3::splat(lambda), DVec3::splat(lambda));
        if law == Law::Linear {
            return Self {
                u: DMat3::IDENTITY,
                v: DMat3::IDENTITY,
                scale: hooke,
                flip: DVec3::splat(2.0 * mu),
                twist: DVec3::ZERO,
            };
        }
        let Svd { u, s, v } = crate::rotation::svd(f);
        let (scale, flip, twist) = match law {
            _ if law.is_of_invariants() => {
                let j = s.x * s.y * s.z;
                let Invariants {
                    mu,
                    slope,
                    curve,
                    stiffening,
                    ..
                } = Invariants::new(law, lame, s.length_squared(), j);
                let c = DVec3::new(s.y * s.z, s.x * s.z, s.x * s.y);
                let g = s + c * (j - 2.0);
                let square = |v: DVec3, k: f64| DMat3::from_cols(v * (k * v.x), v * (k * v.y), v * (k * v.z));
                let mut a = square(c, curve) + square(g, stiffening) + DMat3::from_diagonal(DVec3::splat(mu));
                for (i, j, k) in [(0, 1, 2), (1, 2, 0), (2, 0, 1)] {
                    a.col_mut(i)[j] += slope * s[k];
                    a.col_mut(j)[i] += slope * s[k];
                }
                (a, DVec3::splat(mu) - s * slope, DVec3::splat(mu) + s * slope)
            }
            _ => {
                let pull = lambda * (s.element_sum() - 3.0) - 2.0 * mu;
                let sums = DVec3::new(s.y + s.z, s.z + s.x, s.x + s.y);
                let sums = sums.map(|x| x.abs().max(LEAST_SUM).copysign(x));
                (
                    hooke,
                    DVec3::splat(2.0 * mu),
                    DVec3::splat(2.0 * mu) + 2.0 * pull / sums,
                )
            }
        };
        let mut t = Self {
            u,
            v,
            scale,
            flip,
            twist,
        };
        match mode {
            JacobianMode::Exact => {}
            JacobianMode::Frozen => t.twist = DVec3::ZERO,
            JacobianMode::ExactPositive => t = t.positive(),
        }
        t
    }

    /// The same with its negative eigenvalues set to zero.
    pub fn positive(mut self) -> Self {
        self.flip = self.flip.max(DVec3::ZERO);
        self.twist = self.twist.max(DVec3::ZERO);
        self.scale = positive_part(self.scale);
        self
    }

    /// δP of δF.
    pub fn apply(&self, df: DMat3) -> DMat3 {
        let m = self.u.transpose() * df * self.v;
        let diagonal = self.scale * DVec3::new(m.x_axis.x, m.y_axis.y, m.z_axis.z);
        let mut n = DMat3::from_diagonal(diagonal);
        for (i, j, k) in [(0, 1, 2), (1, 2, 0), (2, 0, 1)] {
            let (a, b) = (m.col(j)[i], m.col(i)[j]);
            let sym = 0.5 * (a + b) * self.flip[k];
            let anti = 0.5 * (a - b) * self.twist[k];
            n.col_mut(j)[i] = sym + anti;
            n.col_mut(i)[j] = sym - anti;
        }
        self.u * n * self.v.transpose()
    }

    /// Stiffness block −∂fᵢ/∂xⱼ = V₀·(…) of two corners with shape gradients `gi`, `gj` (1/mm), per rest volume: times V₀ in mm³ it is
    /// in µN/mm.
    pub fn block(&self, gi: DVec3, gj: DVec3) -> DMat3 {
        let (p, q) = (self.v.transpose() * gi, self.v.transpose() * gj);
        let mut k = DMat3::ZERO;
        for a in 0..3 {
            k.col_mut(a)[a] += self.scale.col(a)[a] * p[a] * q[a];
        }
        for (a, b, c) in [(0, 1, 2), (1, 2, 0), (2, 0, 1)] {
            let (half_sum, half_difference) = (
                0.5 * (self.flip[c] + self.twist[c]),
                0.5 * (self.flip[c] - self.twist[c]),
            );
            k.col_mut(a)[a] += half_sum * p[b] * q[b];
            k.col_mut(b)[b] += half_sum * p[a] * q[a];
            k.col_mut(b)[a] = self.scale.col(b)[a] * p[a] * q[b] + half_difference * p[b] * q[a];
            k.col_mut(a)[b] = self.scale.col(a)[b] * p[b] * q[a] + half_difference * p[a] * q[b];
        }
        self.u * k * self.u.transpose()
    }
}

/// The symmetric matrix with its negative eigenvalues set to zero.
fn positive_part(a: DMat3) -> DMat3 {
    // Gershgorin: most matrices need no change.
    let off = [
        a.y_axis.x.abs() + a.z_axis.x.abs(),
        a.x_axis.y.abs() + a.z_axis.y.abs(),
        a.x_axis.z.abs() + a.y_axis.z.abs(),
    ];
    if (0..3).all(|i| a.col(i)[i] >= off[i]) {
        return a;
    }
    // Shifted until all eigenvalues are positive, the singular value decomposition is the eigendecomposition.
    let shift = a.to_cols_array().iter().map(|x| x.abs()).sum::<f64>();
    let v = crate::rotation::svd(a + DMat3::from_diagonal(DVec3::splat(shift))).v;
    let mut sum = DMat3::ZERO;
    for i in 0..3 {
        let w = v.col(i);
        let eigenvalue = w.dot(a * w).max(0.0);
        sum += DMat3::from_cols(w * w.x, w * w.y, w * w.z) * eigenvalue;
    }
    sum
}
