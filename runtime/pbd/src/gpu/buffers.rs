//! Buffers of a scene, filled from the arrays of the CPU solver.

use super::kernels::Slot;
use super::layout::{
    Body, Cluster, Constants, Entry, Exchange, NO_SOLID, Particle, Plane, Report, SLOTS, Solid, Substep,
};
use super::shapes::{ShapeData, ShapeHead};
use crate::solver::clusters::rotation_of;
use crate::solver::solids::Solids;
use crate::solver::{CHUNK, Core};
use crate::{Averaging, NetMomentum, Pose, Settings, ShapeMatching};
use glam::{DVec3, Vec3, Vec3A};
use palpate_gpu::{Gpu, GpuError, wgpu};

/// Counters of [`crate::ClampCounts`].
pub(crate) const COUNTS: usize = 8;
/// Cells that one workgroup of `grid_scan` sums.
pub(crate) const SCAN_BLOCK: usize = 1024;

/// Sizes of a scene.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Sizes {
    pub particles: usize,
    pub clusters: usize,
    pub bodies: usize,
    pub solids: usize,
    pub cells: usize,
    pub chunks: usize,
    pub substeps: usize,
}

/// All buffers.
#[derive(Debug)]
pub(crate) struct Buffers {
    pub constants: wgpu::Buffer,
    pub substeps: Vec<wgpu::Buffer>,
    pub info: wgpu::Buffer,
    pub x: wgpu::Buffer,
    /// The kernels that exchange positions between particles read one and write the other.
    pub predicted: [wgpu::Buffer; 2],
    pub velocity: wgpu::Buffer,
    pub bodies: wgpu::Buffer,
    pub counts: wgpu::Buffer,
    pub cells: wgpu::Buffer,
    pub starts: wgpu::Buffer,
    pub items: wgpu::Buffer,
    pub candidates: wgpu::Buffer,
    pub correction: wgpu::Buffer,
    pub planes: wgpu::Buffer,
    pub solids: wgpu::Buffer,
    pub shapes: wgpu::Buffer,
    pub clusters: wgpu::Buffer,
    pub members: wgpu::Buffer,
    pub locals: wgpu::Buffer,
    pub frames: wgpu::Buffer,
    pub net: wgpu::Buffer,
    pub entries: wgpu::Buffer,
    pub exchange: wgpu::Buffer,
    pub reports: wgpu::Buffer,
    pub warm: wgpu::Buffer,
}

/// A vector with a fourth number.
pub(crate) fn quad(v: Vec3A, w: f32) -> [f32; 4] {
    v.extend(w).to_array()
}

/// Constants of a scene.
pub(crate) fn constants(core: &Core, s: &Settings) -> (Constants, Sizes) {
    let n = core.particles.x.len();
    let cells = (2 * n).next_power_of_two().clamp(64, 1 << 27);
    let reach = core
        .ranges
        .iter()
        .map(|r| r.half_contact + r.half_margin)
        .fold(0.0, f32::max);
    let cell = (2.0 * reach).max(1e-6);
    let h = s.substep_s();
    let gravity = DVec3::from(s.gravity_mm_s2).as_vec3();
    let keep = if s.force_smoothing_s > 0.0 {
        (1.0 - s.dt_s / s.force_smoothing_s).max(0.0)
    } else {
        0.0
    };
    let drag = Some(s.drag_factor()).filter(|f| *f > 0.0).unwrap_or(1.0);
    let symmetric = s.net_momentum == NetMomentum::Corrected && s.averaging == Averaging::PerGroup;
    let sizes = Sizes {
        particles: n,
        clusters: core.clusters.len(),
        bodies: core.bodies.len(),
        solids: core.solids.list.len(),
        cells,
        chunks: n.div_ceil(CHUNK),
        substeps: s.substeps as usize,
    };
    let constants = Constants {
        gravity: gravity.to_array(),
        h: h as f32,
        down: gravity.normalize_or_zero().to_array(),
        drag_factor: s.drag_factor() as f32,
        particles: n as u32,
        clusters: sizes.clusters as u32,
        bodies: sizes.bodies as u32,
        solids: sizes.solids as u32,
        omega: s.over_relaxation as f32,
        mass_scaling: s.mass_scaling_per_mm as f32,
        sleep: s.sleep_distance_mm as f32,
        max_speed: s.max_speed_mm_s as f32,
        max_change: (s.max_acceleration_mm_s2 * h) as f32,
        restitution: s.restitution as f32,
        friction: s.particle_friction as f32,
        static_friction: s.static_particle_friction.unwrap_or(s.particle_friction) as f32,
        cell,
        inverse_cell: 1.0 / cell,
        hash_mask: cells as u32 - 1,
        contact_width: s.max_particle_contacts,
        rest_filter: u32::from(s.rest_filter),
        passes: s.rotation_iterations,
        total: u32::from(s.averaging == Averaging::Total),
        beta: match s.shape_matching {
            ShapeMatching::Rotation => -1.0,
            ShapeMatching::Linear { beta } => beta as f32,
        },
        substeps: s.substeps,
        chunks: sizes.chunks as u32,
        force_scale: (1e-6 / (h * s.dt_s * drag)) as f32,
        keep: keep as f32,
        symmetric: u32::from(symmetric),
        stabilise_self: u32::from(s.stabilise_self_contacts),
        unused: [0; 2],
    };
    (constants, sizes)
}

/// Solids of all substeps of a step, in the order of priority.
pub(crate) fn solids_of_step(solids: &mut Solids, heads: &[ShapeHead], substeps: u32, out: &mut Vec<Solid>) {
    out.clear();
    let far = |v: Vec3A| v.clamp(Vec3A::splat(-1e30), Vec3A::splat(1e30)).to_array();
    for q in 0..substeps {
        solids.advance(q, substeps);
        for &k in &solids.order {
            let (s, head) = (&solids.list[k], &heads[k]);
            let parts = |p: &Pose| (p.rotation.to_array(), p.translation.to_array());
            let ((from_rotation, from_translation), (to_rotation, to_translation)) =
                (parts(&s.way.from), parts(&s.way.to));
            out.push(Solid {
                from_rotation,
                from_translation,
                kind: head.kind,
                to_rotation,
                to_translation,
                data: head.data,
                lo: far(s.way.lo),
                friction: s.friction,
                hi: far(s.way.hi),
                static_friction: s.static_friction,
                size: head.size,
                distance: s.distance_mm.unwrap_or(-1.0),
            });
        }
    }
}

/// Shapes of all solids in the scene's order, with their heads.
pub(crate) fn shapes(core: &Core) -> (ShapeData, Vec<ShapeHead>) {
    let mut data = ShapeData::default();
    let heads = core.solids.list.iter().map(|s| data.add(&s.shape)).collect();
    (data, heads)
}

/// Rotation, mean and stiffness of every cluster; columns of linear maps follow where they are used.
pub(crate) fn frames(core: &Core, linear: bool) -> Vec<[f32; 4]> {
    let c = &core.clusters;
    let mut out = Vec::with_capacity(if linear { 5 } else { 2 } * c.len());
    for k in 0..c.len() {
        out.push(rotation_of(&c.rotation, k).to_array());
        out.push(quad(c.mean[k], c.stiffness[k]));
    }
    if linear {
        out.resize(5 * c.len(), [0.0; 4]);
    }
    out
}

/// Bodies with their ranges.
fn bodies(core: &Core) -> Vec<Body> {
    (0..core.bodies.len())
        .map(|b| Body {
            half_contact: core.ranges[b].half_contact,
            half_margin: core.ranges[b].half_margin,
            distance: core.distance[b],
            margin: core.margin[b],
            mass: core.mass[b],
            free: core.free[b] as f32,
            first_cluster: core.bodies[b].clusters.start as u32,
            clusters: core.bodies[b].clusters.len() as u32,
            ..Body::default()
        })
        .collect()
}

impl Buffers {
    pub(crate) fn new(
        gpu: &Gpu,
        core: &Core,
        c: &Constants,
        sizes: &Sizes,
        shapes: &ShapeData,
    ) -> Result<Self, GpuError> {
        let (p, clusters) = (&core.particles, &core.clusters);
        let n = sizes.particles;
        let zeroed =
            |label: &str, count: usize, size: usize| gpu.storage_zeroed(label, (count * size) as u64);
        let info: Vec<Particle> = (0..n)
            .map(|i| Particle {
                rest: p.rest[i].to_array(),
                inverse_mass: p.inverse_mass[i],
                body: u32::from(p.body[i]),
                area_mm2: p.area_mm2[i],
                first_entry: clusters.particle_offsets[i],
                entries: clusters.particle_offsets[i + 1] - clusters.particle_offsets[i],
            })
            .collect();
        let rest: Vec<Cluster> = (0..sizes.clusters)
            .map(|k| {
                let m = clusters.inverse_moment[k];
                Cluster {
                    share: clusters.share[k].to_array(),
                    inverse_moment: [m.x_axis, m.y_axis, m.z_axis].map(|v| quad(v, 0.0)),
                    first: clusters.offsets[k],
                    count: clusters.offsets[k + 1] - clusters.offsets[k],
                    unused: [0; 2],
                }
            })
            .collect();
        let entries: Vec<Entry> = clusters
            .entries
            .iter()
            .map(|e| Entry {
                local: e.local,
                cluster: e.cluster,
            })
            .collect();
        let locals: Vec<[f32; 4]> = clusters.local.iter().map(|q| q.to_array()).collect();
        let positions: Vec<[f32; 4]> = p.x.iter().map(|&x| quad(x, 0.0)).collect();
        let slots = if sizes.solids > 0 { n * SLOTS } else { 0 };
        let none = Plane {
            solid: NO_SOLID,
            ..Plane::default()
        };
        let substeps = (0..sizes.substeps)
            .map(|q| {
                gpu.uniform(
                    "substep",
                    &Substep {
                        index: q as u32,
                        first_solid: (q * sizes.solids) as u32,
                        last: u32::from(q + 1 == sizes.substeps),
                        unused: 0,
                    },
                )
            })
            .collect::<Result<Vec<_>, _>>()?;
        Ok(Self {
            constants: gpu.uniform("constants", c)?,
            substeps,
            info: gpu.storage("particles", &info)?,
            x: gpu.storage("positions", &positions)?,
            predicted: [zeroed("predictions", n, 16)?, zeroed("next predictions", n, 16)?],
            velocity: zeroed("velocities", n, 16)?,
            bodies: gpu.storage("bodies", &bodies(core))?,
            counts: zeroed("counts", COUNTS, 4)?,
            cells: zeroed("cells", sizes.cells, 4)?,
            starts: zeroed("cell starts", sizes.cells + sizes.cells.div_ceil(SCAN_BLOCK), 4)?,
            items: zeroed("particles by cell", n, 4)?,
            candidates: zeroed("contact candidates", n * (c.contact_width as usize + 1), 4)?,
            correction: zeroed("corrections", n, 16)?,
            planes: gpu.storage("contact planes", &vec![none; slots.max(1)])?,
            solids: zeroed("solids", sizes.solids * sizes.substeps, size_of::<Solid>())?,
            shapes: gpu.storage("shapes", &shapes.words)?,
            clusters: gpu.storage("clusters", &rest)?,
            members: gpu.storage("cluster members", &clusters.members)?,
            locals: gpu.storage("members' rest places", &locals)?,
            frames: gpu.storage("cluster frames", &frames(core, c.beta >= 0.0))?,
            net: zeroed("net displacements", sizes.clusters, 16)?,
            entries: gpu.storage("memberships", &entries)?,
            exchange: zeroed("exchange", sizes.chunks * sizes.solids, size_of::<Exchange>())?,
            reports: zeroed("reports", sizes.solids, size_of::<Report>())?,
            warm: zeroed("warm", 4, 4)?,
        })
    }

    /// The buffer of a slot. `positions` stands for predictions, `next` for where their next version goes.
    pub(crate) fn of<'a>(
        &'a self,
        slot: Slot,
        substep: usize,
        positions: &'a wgpu::Buffer,
        next: &'a wgpu::Buffer,
    ) -> &'a wgpu::Buffer {
        match slot {
            Slot::Constants => &self.constants,
            Slot::Substep => &self.substeps[substep],
            Slot::Info => &self.info,
            Slot::X => &self.x,
            Slot::Predicted => positions,
            Slot::Next => next,
            Slot::Velocity => &self.velocity,
            Slot::Bodies => &self.bodies,
            Slot::Counts => &self.counts,
            Slot::Cells => &self.cells,
            Slot::Starts => &self.starts,
            Slot::Items => &self.items,
            Slot::Candidates => &self.candidates,
            Slot::Correction => &self.correction,
            Slot::Planes => &self.planes,
            Slot::Solids => &self.solids,
            Slot::Shapes => &self.shapes,
            Slot::Clusters => &self.clusters,
            Slot::Members => &self.members,
            Slot::Locals => &self.locals,
            Slot::Frames => &self.frames,
            Slot::Net => &self.net,
            Slot::Entries => &self.entries,
            Slot::Exchange => &self.exchange,
            Slot::Reports => &self.reports,
            Slot::Warm => &self.warm,
            // Of a set of skinned points, bound by their owner.
            Slot::Tied | Slot::Skinned => &self.frames,
        }
    }
}

/// First three numbers of every row.
pub(crate) fn triples(rows: &[[f32; 4]]) -> Vec<[f32; 3]> {
    rows.iter()
        .map(|r| Vec3::new(r[0], r[1], r[2]).to_array())
        .collect()
}
