//! Pictures drawn on the CPU: flat images with lines and small text, and shaded views of meshes and spheres.

mod canvas;
mod glyph;
mod image;
mod png;

pub use canvas::{Camera, Canvas, Finish, vertex_normals};
pub use image::Image;
pub use png::{base64, encode_png};

/// Red, green, blue in 0–1.
pub type Rgb = [f32; 3];

/// From hexadecimal 0xRRGGBB.
pub const fn rgb(hex: u32) -> Rgb {
    [
        (hex >> 16 & 255) as f32 / 255.0,
        (hex >> 8 & 255) as f32 / 255.0,
        (hex & 255) as f32 / 255.0,
    ]
}

/// `a` with a share `t` of `b`.
pub fn mix(a: Rgb, b: Rgb, t: f32) -> Rgb {
    std::array::from_fn(|k| a[k] + (b[k] - a[k]) * t)
}
