//! Displacement fields of an independent FEM code, node by node. `PALPATE_DATA` names the folder that holds `fem-referee`.

mod common;

use common::{displacements, hold_where, tissue, traction, weightless};
use glam::DVec3;
use palpate_fem::{Equilibrium, Law, Material, Simulation};
use std::io::Read;
use std::path::{Path, PathBuf};

fn folder(test: &str) -> Option<PathBuf> {
    let folder = std::env::var_os("PALPATE_DATA").map(|d| Path::new(&d).join("fem-referee"));
    match folder.filter(|f| f.is_dir()) {
        Some(f) => Some(f),
        None => {
            println!("SKIPPED {test}: set PALPATE_DATA to the folder that holds fem-referee");
            None
        }
    }
}

/// Rows of one array of an `.npz` file, as f64.
fn array<const K: usize>(path: &Path, name: &str) -> Vec<[f64; K]> {
    let mut zip = zip::ZipArchive::new(std::fs::File::open(path).unwrap()).unwrap();
    let index = zip.index_for_name(&format!("{name}.npy")).unwrap();
    let mut entry = zip.by_index_raw(index).unwrap();
    let mut raw = Vec::new();
    entry.read_to_end(&mut raw).unwrap();
    let mut bytes = Vec::new();
    if entry.compression() == zip::CompressionMethod::Stored {
        bytes = raw;
    } else {
        flate2::read::DeflateDecoder::new(&raw[..])
            .read_to_end(&mut bytes)
            .unwrap();
    }
    let header = u16::from_le_bytes([bytes[8], bytes[9]]) as usize;
    let text = String::from_utf8_lossy(&bytes[10..10 + header]).into_owned();
    let data = &bytes[10 + header..];
    let numbers: Vec<f64> = if text.contains("<f8") {
        data.as_chunks::<8>()
            .0
            .iter()
            .map(|c| f64::from_le_bytes(*c))
            .collect()
    } else {
        assert!(text.contains("<i4"), "{text}");
        data.as_chunks::<4>()
            .0
            .iter()
            .map(|c| f64::from(i32::from_le_bytes(*c)))
            .collect()
    };
    let n = numbers.len() / K;
    let columns = text.contains("'fortran_order': True");
    (0..n)
        .map(|r| std::array::from_fn(|k| numbers[if columns { k * n + r } else { r * K + k }]))
        .collect()
}

struct Case {
    simulation: Simulation,
    wanted: Vec<DVec3>,
}

fn load(path: &Path, law: Law) -> Case {
    let points = array::<3>(path, "points_mm");
    let tets: Vec<[u32; 4]> = array::<4>(path, "tets")
        .into_iter()
        .map(|t| t.map(|n| n as u32))
        .collect();
    let wanted = array::<3>(path, "u_mm")
        .into_iter()
        .map(DVec3::from_array)
        .collect();
    let beam = path.file_name().unwrap().to_str().unwrap().starts_with("beam");
    let material = Material {
        law,
        youngs_modulus_pa: if beam { 10_000.0 } else { 5_000.0 },
        poisson_ratio: 0.45,
        ..Material::default()
    };
    let mut simulation = tissue(&points, &tets, material, weightless());
    let s = &mut simulation;
    if beam {
        hold_where(s, [true; 3], |p| p.x.abs() < 1e-9);
        let pull = if law == Law::Linear { -3.0 } else { -25.0 };
        let sum = traction(s, DVec3::new(0.0, 0.0, pull), |p| (p.x - 100.0).abs() < 1e-9);
        assert!((sum.z - pull * 400.0).abs() < 1e-6, "{sum}");
    } else {
        hold_where(s, [true; 3], |p| p.z.abs() < 1e-9);
        let sum = traction(s, DVec3::new(0.0, 0.0, -1500.0), |p| {
            (p.z - 40.0).abs() < 1e-9 && (p.x - 20.0).abs() < 10.1 && (p.y - 20.0).abs() < 10.1
        });
        assert!((sum.z + 0.6e6).abs() < 1e-3, "{sum}");
    }
    Case { simulation, wanted }
}

fn difference(s: &Simulation, wanted: &[DVec3]) -> f64 {
    let found = displacements(s);
    let off: f64 = found
        .iter()
        .zip(wanted)
        .map(|(a, b)| (*a - *b).length_squared())
        .sum();
    let all: f64 = wanted.iter().map(|b| b.length_squared()).sum();
    (off / all).sqrt()
}

#[test]
fn fields_of_an_independent_code() {
    let Some(folder) = folder("fields_of_an_independent_code") else {
        return;
    };
    for (file, law, limit, energy_uj) in [
        ("beam_linear", Law::Linear, 1e-5, 1.0952),
        ("block_linear", Law::Linear, 1e-5, 1188.3),
        ("beam_corot", Law::RotatedLinear, 1e-4, 73.871),
        ("beam_corot", Law::Corotated, 1e-4, 73.871),
        ("block_corot", Law::RotatedLinear, 1e-4, 1312.4),
        ("block_corot", Law::Corotated, 1e-4, 1312.4),
        ("beam_neohooke", Law::NeoHookean, 1e-4, 74.351),
        ("block_neohooke", Law::NeoHookean, 1e-4, 1102.8),
    ] {
        let Case {
            mut simulation,
            wanted,
        } = load(&folder.join(format!("{file}.npz")), law);
        let report = simulation.equilibrium(&Equilibrium::default()).unwrap();
        let off = difference(&simulation, &wanted);
        let energy = simulation.strain_energy_nj() * 1e-3;
        println!("{file} {law:?}: {off:.2e} off, {energy:.4} µJ, {report:?}");
        assert!(
            off < limit,
            "{file} {law:?}: {off:.2e} off, more than {limit:.0e}"
        );
        assert!(
            (energy / energy_uj - 1.0).abs() < 1e-4,
            "{file} {law:?}: {energy} µJ for {energy_uj}"
        );
    }
}

/// `small_referee.txt`, written by the script beside it, so that an independent code judges everywhere.
#[test]
fn small_fields_of_an_independent_code() {
    let mut lines = include_str!("data/small_referee.txt").lines();
    let mut section = |name: &str| -> Vec<Vec<f64>> {
        let (found, count) = lines.next().unwrap().split_once(' ').unwrap();
        assert_eq!(found, name);
        let rows = lines.by_ref().take(count.parse().unwrap());
        rows.map(|l| l.split(' ').map(|x| x.parse().unwrap()).collect())
            .collect()
    };
    let points: Vec<[f64; 3]> = section("points")
        .into_iter()
        .map(|p| [p[0], p[1], p[2]])
        .collect();
    let tets: Vec<[u32; 4]> = section("tets")
        .into_iter()
        .map(|t| {
            let mut tet = [t[0], t[1], t[2], t[3]].map(|n| n as u32);
            let p = tet.map(|n| DVec3::from_array(points[n as usize]));
            if (p[1] - p[0]).dot((p[2] - p[0]).cross(p[3] - p[0])) < 0.0 {
                tet.swap(2, 3);
            }
            tet
        })
        .collect();
    for (name, laws) in [
        ("linear", &[Law::Linear][..]),
        ("corotated", &[Law::RotatedLinear, Law::Corotated]),
        ("neo_hookean", &[Law::NeoHookean]),
    ] {
        let wanted: Vec<DVec3> = section(name)
            .into_iter()
            .map(|u| DVec3::new(u[0], u[1], u[2]))
            .collect();
        for &law in laws {
            let material = Material {
                law,
                youngs_modulus_pa: 10_000.0,
                poisson_ratio: 0.45,
                ..Material::default()
            };
            let mut s = tissue(&points, &tets, material, weightless());
            hold_where(&mut s, [true; 3], |p| p.x.abs() < 1e-9);
            traction(&mut s, DVec3::new(0.0, 0.0, -300.0), |p| p.x > 29.999);
            s.equilibrium(&Equilibrium::default()).unwrap();
            let off = difference(&s, &wanted);
            assert!(off < 1e-6, "{law:?}: {off:.2e}");
        }
    }
}
