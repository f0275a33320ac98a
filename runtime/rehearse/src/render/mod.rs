//! Pictures on the CPU: a z-buffered view of organ, structures, support and instruments beside the ultrasound image.

mod camera;
mod encode;
mod frame;
mod picture;
mod raster;
mod shapes;
mod shared;
#[cfg(test)]
mod tests;

pub use camera::Camera;
pub use encode::{Preview, encode_png};
pub use frame::{FrameText, GreyImage, SceneGeometry, draw_frame};
pub use picture::{Picture, TextSize};
pub use raster::{Item, Material, View3d, draw_view};
pub use shapes::{ball, capsule, polytope, ribbon, tube};
pub use shared::{Mesh, vertex_normals};

/// Red, green, blue, 0 to 1.
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
