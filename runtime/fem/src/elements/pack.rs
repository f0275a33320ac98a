//! Four tets at once: geometry, forces, renewal of Jacobians, blocks.

use super::{Combination, Entry, LazyTest, Pass};
use crate::material::{JacobianMode, Law, Moduli, Tangent};
use crate::rotation::{Mat3x4, get_lane, rotation_x4, set_lane, svd};
use glam::{DMat3, DVec3};
use wide::f64x4;

/// Four tets.
#[derive(Clone, Debug)]
pub(super) struct Pack {
    /// `[corner][lane]`; an empty lane has volume 0 and node 0.
    pub corners: [[u32; 4]; 4],
    /// Gradients of corners 1 to 3.
    pub g: [[f64x4; 3]; 3],
    pub volume: f64x4,
    pub mu: f64x4,
    pub lambda: f64x4,
    pub stiffening: f64x4,
    pub damping_s: f64x4,
    pub law: [Law; 4],
    /// Lanes with a tet.
    pub live: u8,
    /// Lanes of the law of small strains.
    pub linear: u8,
    /// Lanes whose stiffness is kept as blocks instead of as a rotation.
    pub explicit: u8,
    /// max|N|·max|B|·max(λ, α) of Eq. 12, µN/mm.
    pub reach: f64x4,
    /// max|B|, 1/mm.
    pub largest: f64x4,
    /// R in the Jacobian now.
    pub used: Mat3x4,
    /// R·gᵢ in the Jacobian now.
    pub turned: [[f64x4; 3]; 4],
    /// Lanes to be renewed whatever the test says.
    pub stale: u8,
    /// Lanes renewed in the last pass.
    pub renewed: u8,
    /// Corner forces of the last pass.
    pub force: [[f64x4; 3]; 4],
}

pub(super) fn block_index(i: usize, j: usize) -> usize {
    let (i, j) = (i.min(j), i.max(j));
    [0, 3, 5, 6][i] + j
}

pub(super) fn splat3(v: DVec3, lane: usize, out: &mut [f64x4; 3]) {
    for k in 0..3 {
        let mut lanes = out[k].to_array();
        lanes[lane] = v[k];
        out[k] = f64x4::new(lanes);
    }
}

pub(super) fn set(value: &mut f64x4, lane: usize, to: f64) {
    let mut lanes = value.to_array();
    lanes[lane] = to;
    *value = f64x4::new(lanes);
}

pub(super) const IDENTITY: Mat3x4 = [
    [f64x4::ONE, f64x4::ZERO, f64x4::ZERO],
    [f64x4::ZERO, f64x4::ONE, f64x4::ZERO],
    [f64x4::ZERO, f64x4::ZERO, f64x4::ONE],
];

impl Pack {
    pub fn empty() -> Self {
        Self {
            corners: [[0; 4]; 4],
            g: [[f64x4::ZERO; 3]; 3],
            volume: f64x4::ZERO,
            mu: f64x4::ZERO,
            lambda: f64x4::ZERO,
            stiffening: f64x4::ONE,
            damping_s: f64x4::ZERO,
            law: [Law::Corotated; 4],
            live: 0,
            linear: 0,
            explicit: 0,
            reach: f64x4::ZERO,
            largest: f64x4::ONE,
            used: IDENTITY,
            turned: [[f64x4::ZERO; 3]; 4],
            stale: 0,
            renewed: 0,
            force: [[f64x4::ZERO; 3]; 4],
        }
    }

    /// Σ xᵢ gᵢᵀ of each lane.
    pub fn gradient(&self, x: &[DVec3]) -> Mat3x4 {
        let at = |c: usize| -> [f64x4; 3] {
            let p = self.corners[c].map(|n| x[n as usize]);
            std::array::from_fn(|k| f64x4::new(p.map(|p| p[k])))
        };
        let x0 = at(0);
        let mut f = [[f64x4::ZERO; 3]; 3];
        for c in 1..4 {
            let p = at(c);
            for i in 0..3 {
                let d = p[i] - x0[i];
                for j in 0..3 {
                    f[i][j] += d * self.g[c - 1][j];
                }
            }
        }
        // Empty lanes get F = I, so that their rotation is defined.
        if self.live != 0b1111 {
            for lane in (0..4).filter(|l| self.live & (1 << l) == 0) {
                set_lane(&mut f, lane, DMat3::IDENTITY);
            }
        }
        f
    }

    /// R·H(RᵀX) scaled: µ(X + R·Xᵀ·R) + λ·tr(RᵀX)·R.
    fn rotated_hooke(&self, r: &Mat3x4, x: &Mat3x4) -> Mat3x4 {
        let mut trace = f64x4::ZERO;
        // Q = Xᵀ·R
        let mut q = [[f64x4::ZERO; 3]; 3];
        for i in 0..3 {
            for j in 0..3 {
                q[i][j] = x[0][i] * r[0][j] + x[1][i] * r[1][j] + x[2][i] * r[2][j];
            }
            trace += q[i][i];
        }
        let t = self.lambda * trace;
        let mut p = [[f64x4::ZERO; 3]; 3];
        for i in 0..3 {
            for j in 0..3 {
                let rq = r[i][0] * q[0][j] + r[i][1] * q[1][j] + r[i][2] * q[2][j];
                p[i][j] = self.mu * (x[i][j] + rq) + t * r[i][j];
            }
        }
        p
    }

    fn turn_gradients(&mut self) {
        let mut sum = [f64x4::ZERO; 3];
        for c in 0..3 {
            for i in 0..3 {
                let r = &self.used[i];
                let h = r[0] * self.g[c][0] + r[1] * self.g[c][1] + r[2] * self.g[c][2];
                self.turned[c + 1][i] = h;
                sum[i] -= h;
            }
        }
        self.turned[0] = sum;
    }
}

/// A task's share of what only some tets have.
#[derive(Default)]
pub(super) struct Extra<'a> {
    pub blocks: &'a mut [[DMat3; 10]],
    pub last_f: &'a mut [DMat3],
    pub frames: &'a mut [[DMat3; 2]],
}

impl Pack {
    pub fn run(&mut self, pass: &Pass, extra: &mut Extra, first: usize) {
        let f = self.gradient(pass.x);
        let mut r = if self.linear == 0b1111 {
            IDENTITY
        } else {
            rotation_x4(&f)
        };
        if self.linear != 0 && self.linear != 0b1111 {
            for lane in (0..4).filter(|l| self.linear & (1 << l) != 0) {
                set_lane(&mut r, lane, DMat3::IDENTITY);
            }
        }
        if pass.renew {
            self.renew(pass, &f, &r, extra, first);
        }
        // Elastic stress: R·H(RᵀF − I) = R·H(Rᵀ(F − R)).
        let mut strain = f;
        for i in 0..3 {
            for j in 0..3 {
                strain[i][j] -= r[i][j];
            }
        }
        let rate = self.gradient_of_rate(pass.v);
        let mut stress = self.rotated_hooke(&r, &strain);
        for lane in 0..4 {
            if self.law[lane].is_of_invariants() && self.live & (1 << lane) != 0 {
                let lame = self.moduli(lane);
                set_lane(&mut stress, lane, self.law[lane].stress(lame, get_lane(&f, lane)));
            }
        }
        let damp = self.rotated_hooke(&r, &rate);
        for i in 0..3 {
            for j in 0..3 {
                stress[i][j] += self.damping_s * damp[i][j];
            }
        }
        if let Some([pv, pa, pd]) = pass.predict {
            let rate_a = self.gradient_of_rate(pass.a);
            let stiff = f64x4::new(std::array::from_fn(|l| f64::from(self.explicit & (1 << l) == 0)));
            let (cv, ca) = (stiff * pv, stiff * pa + self.damping_s * pd);
            let mut q = rate;
            for i in 0..3 {
                for j in 0..3 {
                    q[i][j] = rate[i][j] * cv + rate_a[i][j] * ca;
                }
            }
            let ahead = self.rotated_hooke(&self.used, &q);
            for i in 0..3 {
                for j in 0..3 {
                    stress[i][j] += ahead[i][j];
                }
            }
        }
        let mut sum = [f64x4::ZERO; 3];
        for c in 0..3 {
            for i in 0..3 {
                let p = &stress[i];
                let t = p[0] * self.g[c][0] + p[1] * self.g[c][1] + p[2] * self.g[c][2];
                let force = -(self.volume * t);
                self.force[c + 1][i] = force;
                sum[i] -= force;
            }
        }
        self.force[0] = sum;
        if let Some([pv, pa, _]) = pass.predict
            && self.explicit != 0
        {
            for lane in (0..4).filter(|l| self.explicit & (1 << l) != 0) {
                let w: [DVec3; 4] = std::array::from_fn(|c| {
                    let n = self.corners[c][lane] as usize;
                    pass.v[n] * pv + pass.a[n] * pa
                });
                let b = &extra.blocks[first + lane];
                for i in 0..4 {
                    let mut add = DVec3::ZERO;
                    for (j, w) in w.iter().enumerate() {
                        let block = &b[block_index(i, j)];
                        add += if i <= j {
                            *block * *w
                        } else {
                            block.transpose() * *w
                        };
                    }
                    for k in 0..3 {
                        let now = self.force[i][k].to_array()[lane];
                        set(&mut self.force[i][k], lane, now - add[k]);
                    }
                }
            }
        }
    }

    /// Gradient of velocities or accelerations: as [`Pack::gradient`], zero in empty lanes (all corners are node 0).
    pub fn gradient_of_rate(&self, v: &[DVec3]) -> Mat3x4 {
        let at = |c: usize| -> [f64x4; 3] {
            let p = self.corners[c].map(|n| v[n as usize]);
            std::array::from_fn(|k| f64x4::new(p.map(|p| p[k])))
        };
        let v0 = at(0);
        let mut f = [[f64x4::ZERO; 3]; 3];
        for c in 1..4 {
            let p = at(c);
            for i in 0..3 {
                let d = p[i] - v0[i];
                for j in 0..3 {
                    f[i][j] += d * self.g[c - 1][j];
                }
            }
        }
        f
    }

    pub fn moduli(&self, lane: usize) -> Moduli {
        Moduli {
            mu_pa: self.mu.to_array()[lane],
            lambda_pa: self.lambda.to_array()[lane],
            stiffening: self.stiffening.to_array()[lane],
        }
    }

    /// Tests each lane and renews its part of the Jacobian.
    fn renew(&mut self, pass: &Pass, f: &Mat3x4, r: &Mat3x4, extra: &mut Extra, first: usize) {
        let mut renew = self.stale & self.live;
        if pass.threshold < 0.0 {
            renew = self.live;
        } else if renew != self.live {
            renew |= match pass.test {
                LazyTest::Rotation => self.rotation_test(pass, f, r, extra, first),
                LazyTest::Force => self.force_test(pass, f, r, extra, first),
                LazyTest::Printed => self.printed_test(pass, f, extra, first),
            } & self.live;
        }
        self.renewed = renew;
        self.stale = 0;
        if renew == 0 {
            return;
        }
        for lane in (0..4).filter(|l| renew & (1 << l) != 0) {
            if renew != 0b1111 {
                set_lane(&mut self.used, lane, get_lane(r, lane));
            }
            if pass.test == LazyTest::Printed {
                let d = svd(get_lane(f, lane));
                extra.frames[first + lane] = follow([d.u, d.v], extra.frames[first + lane]);
            }
            if self.explicit & (1 << lane) != 0 {
                let one = get_lane(f, lane);
                let mut tangent = Tangent::new(self.law[lane], self.moduli(lane), one, pass.mode);
                if pass.mode == JacobianMode::Frozen {
                    tangent = tangent.positive();
                }
                let volume = self.volume.to_array()[lane];
                let g: [DVec3; 3] =
                    std::array::from_fn(|c| DVec3::from_array(self.g[c].map(|v| v.to_array()[lane])));
                let blocks = &mut extra.blocks[first + lane];
                for i in 1..4 {
                    for j in i..4 {
                        blocks[block_index(i, j)] = tangent.block(g[i - 1], g[j - 1]) * volume;
                    }
                }
                // Gradients sum to zero, and so do the blocks of a row.
                let [_, _, _, _, b11, b12, b13, b22, b23, b33] = *blocks;
                blocks[1] = -(b11 + b12.transpose() + b13.transpose());
                blocks[2] = -(b12 + b22 + b23.transpose());
                blocks[3] = -(b13 + b23 + b33);
                blocks[0] = -(blocks[1] + blocks[2] + blocks[3]);
                extra.last_f[first + lane] = one;
            }
        }
        if renew == 0b1111 {
            self.used = *r;
        }
        self.turn_gradients();
    }

    fn rotation_test(&self, pass: &Pass, f: &Mat3x4, r: &Mat3x4, extra: &Extra, first: usize) -> u8 {
        (self.change(f, r, extra, first) * self.reach)
            .simd_gt(f64x4::splat(pass.threshold))
            .to_bitmask() as u8
    }

    fn force_test(&self, pass: &Pass, f: &Mat3x4, r: &Mat3x4, extra: &Extra, first: usize) -> u8 {
        let mut rate = f64x4::ZERO;
        for x in self.gradient_of_rate(pass.v).iter().flatten() {
            rate = rate.max(x.abs());
        }
        let force = self.change(f, r, extra, first) * rate * f64x4::splat(pass.dt) * self.reach;
        force
            .simd_gt(self.largest * f64x4::splat(pass.threshold))
            .to_bitmask() as u8
    }

    /// Largest change of an entry of R since the last renewal, or of F where the Jacobian depends on more.
    fn change(&self, f: &Mat3x4, r: &Mat3x4, extra: &Extra, first: usize) -> f64x4 {
        let mut change = f64x4::ZERO;
        for i in 0..3 {
            for j in 0..3 {
                change = change.max((r[i][j] - self.used[i][j]).abs());
            }
        }
        for lane in (0..4).filter(|l| self.explicit & (1 << l) != 0) {
            let d = get_lane(f, lane) - extra.last_f[first + lane];
            let most = d.to_cols_array().iter().fold(0.0f64, |m, x| m.max(x.abs()));
            let now = change.to_array()[lane];
            set(&mut change, lane, most.max(now));
        }
        change
    }

    fn printed_test(&self, pass: &Pass, f: &Mat3x4, extra: &Extra, first: usize) -> u8 {
        let most = |m: DMat3| m.to_cols_array().iter().fold(0.0f64, |m, x| m.max(x.abs()));
        let mut mask = 0;
        for lane in (0..4).filter(|l| self.live & (1 << l) != 0) {
            let d = svd(get_lane(f, lane));
            let last = extra.frames[first + lane];
            let [u, v] = follow([d.u, d.v], last);
            let product = most(u - last[0]) * most(v - last[1]);
            if product * product * self.reach.to_array()[lane] > pass.threshold {
                mask |= 1 << lane;
            }
        }
        mask
    }

    pub fn add_blocks(&self, lane: usize, e: &Entry, c: Combination, blocks: &mut [DMat3]) {
        let stiff = if self.explicit & (1 << lane) != 0 {
            0.0
        } else {
            c.stiffness
        };
        let scale = self.volume.as_array()[lane] * (stiff + c.damping * self.damping_s.as_array()[lane]);
        let mu = scale * self.mu.as_array()[lane];
        let lambda = scale * self.lambda.as_array()[lane];
        let h = |k: usize| {
            let t = &self.turned[k];
            DVec3::new(
                t[0].as_array()[lane],
                t[1].as_array()[lane],
                t[2].as_array()[lane],
            )
        };
        let hi = h(e.corner as usize);
        let mu_hi = hi * mu;
        for j in 0..4 {
            let hj = h(j);
            let lambda_hj = hj * lambda;
            let along = mu_hi.dot(hj);
            let b = &mut blocks[e.at[j] as usize];
            for k in 0..3 {
                *b.col_mut(k) += hj * mu_hi[k] + hi * lambda_hj[k];
            }
            b.x_axis.x += along;
            b.y_axis.y += along;
            b.z_axis.z += along;
        }
    }
}

/// U and V with the signs of the columns that V had before.
pub(super) fn follow([mut u, mut v]: [DMat3; 2], last: [DMat3; 2]) -> [DMat3; 2] {
    for i in 0..3 {
        if v.col(i).dot(last[1].col(i)) < 0.0 {
            *u.col_mut(i) *= -1.0;
            *v.col_mut(i) *= -1.0;
        }
    }
    [u, v]
}
