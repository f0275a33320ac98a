//! Needles that bend: the elastica of a cantilever at four loads, and a bowed wire that leaves its plane for a helix as its end is turned.
//!
//! `cargo run --release -p palpate-needle --example bend -- OUT` writes OUT/elastica.csv, OUT/twist.csv and OUT/bend.png: on top the
//! elastica (1 pixel = 0.25 mm), below the twisted wire from the side and from above, darker as its end has turned further.

use glam::{DVec2, DVec3};
use palpate_needle::{
    BaseMotion, EquilibriumParams, Held, Loads, NeedleError, NeedleParams, NewmarkParams, Rod,
};
use std::error::Error;
use std::fmt::Write as _;
use std::fs::{self, File};
use std::path::Path;

const SIZE: [usize; 2] = [900, 900];

fn main() -> Result<(), Box<dyn Error>> {
    let out = std::env::args().nth(1).ok_or("usage: bend OUT")?;
    let out = Path::new(&out);
    fs::create_dir_all(out)?;
    let mut image = vec![255u8; SIZE[0] * SIZE[1] * 3];

    let mut csv = String::from("load_un,node,x_mm,y_mm\n");
    for (alpha, colour) in [
        (1.0, [30, 110, 200]),
        (2.0, [20, 150, 120]),
        (5.0, [210, 130, 20]),
        (10.0, [200, 40, 60]),
    ] {
        let (rod, load) = elastica(alpha)?;
        for (i, p) in rod.position().iter().enumerate() {
            writeln!(csv, "{load},{i},{},{}", p.x, p.y)?;
        }
        let line: Vec<DVec2> = rod
            .position()
            .iter()
            .map(|p| DVec2::new(60.0 + 4.0 * p.x, 380.0 - 4.0 * p.y))
            .collect();
        draw(&mut image, &line, colour);
        let tip = rod.position()[rod.position().len() - 1];
        println!(
            "P L^2/EI {alpha:4}: tip at {:.4} L along, {:.4} L across",
            tip.x / 100.0,
            tip.y / 100.0
        );
    }
    fs::write(out.join("elastica.csv"), csv)?;

    let mut csv = String::from("turn_rad,node,x_mm,y_mm,z_mm\n");
    for (turn, rod) in twisted()? {
        for (i, p) in rod.position().iter().enumerate() {
            writeln!(csv, "{turn},{i},{},{},{}", p.x, p.y, p.z)?;
        }
        let shade = (200.0 - 9.0 * turn).clamp(0.0, 200.0) as u8;
        let side: Vec<DVec2> = rod
            .position()
            .iter()
            .map(|p| DVec2::new(60.0 + 5.0 * p.x, 620.0 - 5.0 * p.y))
            .collect();
        draw(&mut image, &side, [shade, shade, 220]);
        let above: Vec<DVec2> = rod
            .position()
            .iter()
            .map(|p| DVec2::new(60.0 + 5.0 * p.x, 780.0 + 5.0 * p.z))
            .collect();
        draw(&mut image, &above, [220, shade, shade]);
        let out_of_plane = rod.position().iter().fold(0.0, |m: f64, p| m.max(p.z.abs()));
        println!("end turned by {turn:5.2} rad: {out_of_plane:.3} mm out of its plane");
    }
    fs::write(out.join("twist.csv"), csv)?;

    let mut encoder = png::Encoder::new(
        File::create(out.join("bend.png"))?,
        SIZE[0] as u32,
        SIZE[1] as u32,
    );
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header()?.write_image_data(&image)?;
    Ok(())
}

/// Cantilever of 100 mm under a load across it, and the load in µN.
fn elastica(alpha: f64) -> Result<(Rod, f64), NeedleError> {
    let mut rod = Rod::in_sleeve(
        NeedleParams::default(),
        DVec3::ZERO,
        DVec3::X,
        DVec3::Y,
        5.0,
        100.0,
        80,
    )?;
    let load = alpha * rod.stiffness().bending_un_mm2[0] / 1e4;
    let mut nodal_un = vec![DVec3::ZERO; rod.position().len()];
    if let Some(tip) = nodal_un.last_mut() {
        *tip = DVec3::new(0.0, load, 0.0);
    }
    let settle = EquilibriumParams {
        tolerance_un: 1.0,
        ..Default::default()
    };
    rod.equilibrium(
        &Loads {
            nodal_un,
            ..Default::default()
        },
        &settle,
    )?;
    Ok((rod, load))
}

/// A wire of about 150 mm bowed between clamps, its far end turned by π/4 a second; a shape for every half turn.
fn twisted() -> Result<Vec<(f64, Rod)>, NeedleError> {
    let edges = 75;
    let bow = |k: usize| {
        let s = k as f64 / edges as f64;
        DVec3::new(140.0 * s, 14.0 * (1.0 - (std::f64::consts::TAU * s).cos()), 0.0)
    };
    let mut nodes = vec![DVec3::new(-2.0, 0.0, 0.0)];
    nodes.extend((0..=edges).map(bow));
    nodes.push(DVec3::new(142.0, 0.0, 0.0));
    let mut rod = Rod::new(
        NeedleParams::default(),
        nodes,
        DVec3::Y,
        Held {
            base: true,
            tip: true,
        },
    )?;
    let mut shapes = vec![];
    // The slightest push out of the plane, so that the symmetric state is not kept for ever.
    let loads = Loads {
        gravity_mm_per_s2: DVec3::new(0.0, 0.0, 1.0),
        ..Default::default()
    };
    let (step, turn) = (
        NewmarkParams {
            dt_s: 0.01,
            ..Default::default()
        },
        std::f64::consts::PI / 400.0,
    );
    for k in 0..=2800 {
        if k % 400 == 0 {
            shapes.push((f64::from(k) * turn, rod.clone()));
        }
        rod.turn_ends(0.0, turn)?;
        rod.step(&step, &BaseMotion::default(), &loads)?;
    }
    Ok(shapes)
}

fn draw(image: &mut [u8], line: &[DVec2], colour: [u8; 3]) {
    for pair in line.windows(2) {
        let count = (2.0 * pair[0].distance(pair[1])).ceil() as usize + 1;
        for k in 0..=count {
            let p = pair[0].lerp(pair[1], k as f64 / count as f64);
            for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                let (x, y) = (p.x as isize + dx, p.y as isize + dy);
                if x >= 0 && y >= 0 && (x as usize) < SIZE[0] && (y as usize) < SIZE[1] {
                    let at = 3 * (y as usize * SIZE[0] + x as usize);
                    image[at..at + 3].copy_from_slice(&colour);
                }
            }
        }
    }
}
