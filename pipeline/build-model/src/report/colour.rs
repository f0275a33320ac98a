use crate::draw::{Rgb, rgb};

/// Colours that stay apart for colour-blind readers (after Okabe and Ito): the organ, then structures in order.
const REGIONS: [Rgb; 7] = [
    rgb(0xE3BFA3),
    rgb(0x1F6FB4),
    rgb(0x009E73),
    rgb(0xD55E00),
    rgb(0xCC79A7),
    rgb(0xE8D21D),
    rgb(0x56B4E9),
];

/// Static colliders.
pub const SUPPORT: Rgb = rgb(0x9AA0A6);
/// Outline of a collision surface in a slice.
pub const SURFACE_LINE: Rgb = rgb(0x2F8FEF);
/// Outline of the FEM mesh in a slice.
pub const FEM_LINE: Rgb = rgb(0xF5B942);
/// Outline of the labels in a slice.
pub const LABEL_LINE: Rgb = rgb(0xFFFFFF);
/// Edges of elements.
pub const EDGE: Rgb = rgb(0x33383D);
/// Ground of the shaded views.
pub const GROUND: Rgb = rgb(0xFFFFFF);
/// Letters on a light ground.
pub const INK: Rgb = rgb(0x4A5056);

/// Region 0 is the organ proper, n + 1 structure n; past the last colour they repeat without the organ's.
pub fn region(n: usize) -> Rgb {
    if n < REGIONS.len() {
        REGIONS[n]
    } else {
        REGIONS[1 + (n - 1) % (REGIONS.len() - 1)]
    }
}

/// Hues a golden angle apart, so that numbers in sequence get colours far from each other.
pub fn cluster(n: usize) -> Rgb {
    let hue = (n as f64 * 0.618_033_988_749_895).fract() * 6.0;
    let (saturation, value) = ([0.62, 0.45, 0.78][n % 3], [0.95, 0.85, 0.74][n / 3 % 3]);
    [5.0, 3.0, 1.0].map(|shift| {
        let k: f64 = (shift + hue) % 6.0;
        (value - value * saturation * k.min(4.0 - k).clamp(0.0, 1.0)) as f32
    })
}

/// As in a style sheet.
pub fn css(c: Rgb) -> String {
    let [r, g, b] = c.map(|v| (v * 255.0 + 0.5) as u8);
    format!("#{r:02x}{g:02x}{b:02x}")
}
