use super::*;
use crate::solver::Core;
use crate::solver::particles::Integration;
use crate::{Collider, Convex, RawBody, Scene, Settings, Shape, SoftBody, Solver, TriangleMesh};

struct Random(u32);

impl Random {
    /// −1 to 1.
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (self.0 >> 8) as f32 / (1 << 23) as f32 - 1.0
    }

    fn vector(&mut self, size: f32) -> Vec3 {
        Vec3::new(self.next(), self.next(), self.next()) * size
    }

    fn turn(&mut self, angle: f32) -> Quat {
        Quat::from_scaled_axis(self.vector(angle))
    }
}

fn block(n: u32) -> SoftBody {
    let mut raw = RawBody {
        stiffness: 0.5,
        spacing_mm: 2.0,
        mass_g: 8e-3,
        ..RawBody::default()
    };
    let mut random = Random(1);
    for at in 0..n * n * n {
        let p = Vec3::new((at % n) as f32, (at / n % n) as f32, (at / (n * n)) as f32) * 2.0;
        raw.positions.push((p + random.vector(0.1)).to_array());
    }
    for k in 0..8 {
        let sign = |bit: u32| if k & bit != 0 { 0.75 } else { 0.25 };
        let seed = Vec3::new(sign(1), sign(2), sign(4)) * 2.0 * (n - 1) as f32;
        let near = |&i: &u32| Vec3::from(raw.positions[i as usize]).distance(seed) < 0.95 * n as f32;
        raw.clusters
            .push((0..raw.positions.len() as u32).filter(near).collect());
    }
    SoftBody::from_raw(&raw).unwrap()
}

/// A sheet of uneven triangles, slivers among them, along z = 0.
fn uneven_sheet() -> TriangleMesh {
    let mut random = Random(5);
    let mut mesh = TriangleMesh::default();
    for k in 0..21 * 21 {
        let flat = Vec3::new((k % 21) as f32 - 10.0, (k / 21) as f32 - 10.0, 0.0) * 2.0;
        let shake = random.vector(0.95) * Vec3::new(1.0, 1.0, 0.6);
        mesh.vertices.push((flat + shake).to_array());
    }
    for k in (0..20 * 21).filter(|k| k % 21 < 20) {
        mesh.triangles
            .extend([[k, k + 1, k + 21], [k + 1, k + 22, k + 21]]);
    }
    mesh
}

/// Two blocks among solids of every kind, most of which move.
fn scene() -> Scene {
    let y_up = Quat::from_rotation_arc(Vec3::Z, Vec3::Y);
    let other = block(5).placed(Pose::at(Vec3::new(1.0, 22.0, 2.0)));
    let ball = TriangleMesh::cuboid(Vec3::splat(4.0));
    let wedge = [
        ([1.0, 1.0, 0.0], 3.0),
        ([-1.0, 1.0, 0.0], 3.0),
        ([0.0, -1.0, 0.2], 4.0),
        ([0.0, 0.0, 1.0], 6.0),
        ([0.0, 0.0, -1.0], 6.0),
    ];
    let at = |x, y, z| Pose::at(Vec3::new(x, y, z));
    Scene::new(
        vec![block(9), other],
        vec![
            Collider::plane("floor", Vec3::Y * -2.5, Vec3::new(0.02, 1.0, 0.0)),
            Collider::fixed(
                "sheet",
                Shape::Mesh(uneven_sheet()),
                Pose::new(y_up, Vec3::new(8.0, -2.0, 8.0)),
            ),
            Collider::moving(
                "probe",
                Shape::Cuboid {
                    half_extents_mm: Vec3::new(4.0, 3.0, 6.0),
                },
                at(8.0, 23.0, 8.0),
            ),
            Collider::moving(
                "box",
                Shape::Mesh(TriangleMesh::cuboid(Vec3::new(5.0, 4.0, 3.0))),
                at(23.0, 4.0, 8.0),
            ),
            Collider::moving(
                "field",
                Shape::Grid(SignedDistanceGrid::from_mesh(&ball, 0.7, 3.0).unwrap()),
                at(-6.0, 6.0, 8.0),
            ),
            Collider::moving(
                "rod",
                Shape::Capsule {
                    half_length_mm: 7.0,
                    radius_mm: 2.0,
                },
                at(8.0, 8.0, -4.0),
            ),
            Collider::moving(
                "wedge",
                Shape::Convex(Convex::new(&wedge).unwrap()),
                at(8.0, 8.0, 25.0),
            ),
        ],
    )
}

/// Contact planes of every particle, each solid asked anew.
fn direct(core: &Core, how: &ShapeContact) -> Vec<Vec<PlaneContact>> {
    let (p, solids) = (&core.particles, &core.solids);
    (0..p.x.len())
        .map(|i| {
            let mut out = Vec::new();
            let (x, predicted) = (p.x[i], p.predicted[i]);
            for &k in &solids.order {
                let s = &solids.list[k];
                let distance = how.distance[usize::from(p.body[i])];
                let reach = distance + how.margin[usize::from(p.body[i])];
                if s.way.lo.cmpgt(x.max(predicted) + reach).any()
                    || s.way.hi.cmplt(x.min(predicted) - reach).any()
                {
                    continue;
                }
                let (a, b) = s.way.local(x, predicted);
                let mut found = LocalContacts::default();
                let motion = Motion {
                    a,
                    b,
                    distance,
                    reach,
                };
                s.shape.contacts(&motion, &mut found);
                for c in found.as_slice().iter().take(SLOTS - out.len()) {
                    let normal = s.way.to.rotation * c.normal;
                    let point = s.way.to.apply(c.point);
                    out.push(PlaneContact {
                        normal,
                        offset: normal.dot(point) + distance,
                        drift: point - s.way.from.apply(c.point),
                        solid: k as u32,
                    });
                }
            }
            out
        })
        .collect()
}

/// Searches from where the solver is, as its next substep would, and compares; gives contacts and skipped particles.
fn compare(solver: &mut Solver, when: &str) -> (usize, usize) {
    let s = solver.settings.clone();
    let core = &mut solver.core;
    let before = core.particles.clone();
    core.solids.advance(0, s.substeps);
    core.particles.predict(&Integration {
        h: s.substep_s() as f32,
        gravity: Vec3A::new(0.0, -9810.0, 0.0),
        drag_factor: s.drag_factor() as f32,
        mass_scaling: 0.0,
        sleep: 0.0,
        max_speed: 0.0,
        max_change: 1e9,
    });
    let how = ShapeContact {
        distance: &core.distance,
        margin: &core.margin,
        mass: &core.mass,
        omega: 1.0,
        total: false,
    };
    core.solids.find(&core.particles, &how, &mut core.counts);
    let skipped = core.solids.memory.chunks.iter().flat_map(|c| &c.until);
    let skipped = skipped.filter(|u| **u > f32::NEG_INFINITY).count();
    let mut contacts = 0;
    for (i, want) in direct(core, &how).iter().enumerate() {
        let got = core.solids.row(i);
        let bits = |c: &PlaneContact| {
            let f = [c.normal.to_array(), c.drift.to_array()].concat();
            (
                f.iter().map(|v| v.to_bits()).collect::<Vec<_>>(),
                c.offset.to_bits(),
                c.solid,
            )
        };
        assert!(
            got.len() == want.len() && got.iter().zip(want).all(|(a, b)| bits(a) == bits(b)),
            "{when}, particle {i}: {got:?} instead of {want:?}"
        );
        contacts += got.len();
    }
    core.particles = before;
    (contacts, skipped)
}

/// Presses, turns, jumps and goes back.
fn session(threads: usize, mut each: impl FnMut(&mut Solver, usize)) -> Solver {
    let mut s = Solver::with_threads(scene(), Settings::default(), threads).unwrap();
    let mut random = Random(9);
    let mut saved = s.save();
    for step in 0..300 {
        for k in 1..7 {
            let old = s.pose(k).unwrap();
            let quiet = step % 40 < 15 || k == 1;
            if !quiet && (step + k) % 3 > 0 {
                // Slow ones, quick ones, turns of up to a radian.
                let quick = if step % 50 == 25 { 10.0 } else { 1.0 };
                let to = Pose::new(
                    random.turn(0.06 * quick) * old.rotation,
                    old.translation + random.vector(0.3 * quick),
                );
                s.set_pose(k, to).unwrap();
            }
            if step % 60 == 59 {
                s.place(k, Pose::new(old.rotation, old.translation + random.vector(3.0)))
                    .unwrap();
            }
        }
        match step {
            70 => saved = s.save(),
            120 | 121 | 200 => s.restore(&saved).unwrap(),
            160 => {
                let still = vec![[0.0; 3]; s.positions().len()];
                let elsewhere: Vec<[f32; 3]> = s
                    .positions()
                    .iter()
                    .map(|p| (Vec3::from(*p) + random.vector(4.0)).to_array())
                    .collect();
                s.set_particles(&elsewhere, &still).unwrap();
            }
            _ => {}
        }
        each(&mut s, step);
        s.step();
    }
    s
}

#[test]
fn contacts_are_those_of_a_search_without_memory() {
    let (mut contacts, mut skipped, mut all) = (0, 0, 0);
    let watched = session(2, |s, step| {
        let (c, k) = compare(s, &format!("step {step}"));
        (contacts, skipped) = (contacts + c, skipped + k);
        all += s.positions().len();
    });
    assert!(contacts > 50_000, "only {contacts} contacts");
    assert!(skipped > all / 3, "only {skipped} of {all} need no search");
    let forgetful = session(1, |s, _| s.core.solids.forget());
    let plain = session(3, |_, _| ());
    assert_eq!(plain.digest(), forgetful.digest());
    assert_eq!(plain.digest(), watched.digest());
    assert_eq!(plain.contacts(), forgetful.contacts());
}

#[test]
fn rows_hold_every_triangle_that_can_count() {
    let mesh = MeshSolid::new(&uneven_sheet());
    let grid = mesh.grid().unwrap();
    let mut random = Random(77);
    let (mut used, mut listed, mut rows) = (0, 0, 0);
    for _ in 0..4000 {
        let base = random.vector(1.0) * Vec3::new(18.0, 18.0, 3.0);
        let (distance, reach) = (1.5, 2.25);
        let (skin, sweep) = (0.07, 0.4);
        let motion = |a, b| Motion {
            a,
            b,
            distance,
            reach,
        };
        let mut row = [0; 64];
        let Some(n) = mesh.near(&motion(base, base), skin, sweep, 2e-3, &mut row) else {
            panic!("more than 64 triangles at {base}");
        };
        rows += 1;
        listed += n;
        for _ in 0..20 {
            let a = base + random.vector(1.0).normalize_or(Vec3::X) * sweep * 0.999;
            let b = base + random.vector(1.0).normalize_or(Vec3::X) * skin * 0.999;
            let (mut all, mut some) = (LocalContacts::default(), LocalContacts::default());
            mesh.contacts(&grid, &motion(a, b), &mut all);
            if !mesh.is_beyond(&grid, &motion(a, b)) {
                mesh.contacts_among(&grid, &motion(a, b), &row[..n], &mut some);
            }
            assert_eq!(format!("{all:?}"), format!("{some:?}"), "{a} to {b} near {base}");
            used += all.as_slice().len();
        }
    }
    assert!(used > 20_000, "{used} contacts");
    println!(
        "{} triangles a row, {} contacts",
        listed as f32 / rows as f32,
        used as f32 / 20.0 / rows as f32
    );
}
