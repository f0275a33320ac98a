//! Images as files' bytes: PNG, NIfTI, metadata.

use crate::nifti::{Voxels, encode};
use crate::{
    Image, Level, Organ, PixelGrid, Probe, ProbePose, Scanner, Settings, SliceImage, Source, UltrasoundError,
};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What there is to know of an image besides its pixels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Metadata {
    /// Program and version that made the image.
    pub generator: String,
    /// What was computed.
    pub level: Level,
    /// The transducer.
    pub probe: Probe,
    /// Its pose, patient RAS+ mm.
    pub pose: ProbePose,
    /// Pixels in the plane, mm.
    pub grid: PixelGrid,
    /// Affine (column, row, 0) → patient RAS+ mm, row-major 3×4.
    pub affine: [[f64; 4]; 3],
    /// All settings.
    pub settings: Settings,
    /// Organs in the image.
    pub organs: Vec<OrganMetadata>,
    /// Tets of all meshes that are inverted or not finite, in this plane or not.
    pub inverted_tets: usize,
    /// Pixels by where their value is from; at the levels with sound samples on scan lines of the middle plane.
    pub counts: BTreeMap<String, usize>,
    /// What the counts count: `pixels` or `samples`.
    pub counted: String,
    /// What must not be read into the image.
    pub notes: Vec<String>,
}

/// An organ in the metadata.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OrganMetadata {
    /// Name.
    pub name: String,
    /// Whether its CT values are nominal ones by label, for want of a scan.
    pub nominal: bool,
    /// Then: the tissue and its nominal CT value for each label and the surroundings, as `label: tissue, HU`.
    pub nominal_tissues: Vec<String>,
    /// Mean voxel size of its scan, mm: detail below this is interpolation.
    pub voxel_mm: f64,
}

fn metadata(
    scanner: &Scanner,
    level: Level,
    pose: &ProbePose,
    inverted_tets: usize,
    counts: [usize; 7],
) -> Metadata {
    let settings = scanner.settings();
    let organs: Vec<OrganMetadata> = scanner
        .organs()
        .iter()
        .map(|o| OrganMetadata {
            name: o.name().to_owned(),
            nominal: o.is_nominal(),
            nominal_tissues: o.nominal_tissues.clone(),
            voxel_mm: o.volume.spacing_mm,
        })
        .collect();
    let mut notes = vec![
        "the deformation follows from a stiffness that is not calibrated for this patient's tissue"
            .to_owned(),
    ];
    for o in organs.iter().filter(|o| o.nominal) {
        notes.push(format!(
            "{}: the package has no CT; values are nominal ones of the labels' tissues: {}",
            o.name,
            o.nominal_tissues.join(", ")
        ));
    }
    if level >= Level::Rays {
        notes.push(
            "acoustics from tables and labels, not measured on this patient; echo levels are relative".into(),
        );
        notes.push(
            "drawn at 1540 m/s throughout: no distortion by the speed of sound, no refraction of the beam"
                .into(),
        );
    }
    if level >= Level::BMode {
        notes.push("speckle is synthetic; it follows the mesh's motion".into());
    }
    let name = |s: Source| match serde_json::to_value(s) {
        Ok(serde_json::Value::String(name)) => name,
        _ => format!("{s:?}"),
    };
    Metadata {
        generator: concat!("palpate-ultrasound ", env!("CARGO_PKG_VERSION")).to_owned(),
        level,
        probe: *scanner.probe(),
        pose: *pose,
        grid: *scanner.grid(),
        affine: scanner.grid().affine(pose, thickness(scanner.probe())),
        settings: settings.clone(),
        organs,
        inverted_tets,
        counts: Source::ALL.into_iter().map(name).zip(counts).collect(),
        counted: if level >= Level::Rays { "samples" } else { "pixels" }.to_owned(),
        notes,
    }
}

/// Thickness of the slice in files: the beam's, at least 0.1 mm so that the affine can be inverted.
fn thickness(probe: &Probe) -> f64 {
    probe.thickness_mm.max(0.1)
}

/// What a NIfTI file's description adds where an organ has no CT.
fn nominal(scanner: &Scanner) -> &'static str {
    if scanner.organs().iter().any(Organ::is_nominal) {
        "; nominal HU"
    } else {
        ""
    }
}

fn png(grid: &PixelGrid, grey: &[u8]) -> Result<Vec<u8>, UltrasoundError> {
    let mut out = Vec::new();
    let mut encoder = png::Encoder::new(&mut out, grid.width_px as u32, grid.height_px as u32);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    let per_metre = (1000.0 / grid.pixel_mm).round() as u32;
    encoder.set_pixel_dims(Some(png::PixelDimensions {
        xppu: per_metre,
        yppu: per_metre,
        unit: png::Unit::Meter,
    }));
    let mut writer = encoder.write_header()?;
    writer.write_image_data(grey)?;
    writer.finish()?;
    Ok(out)
}

impl Image<'_> {
    /// An 8-bit grey PNG file.
    ///
    /// # Errors
    /// The encoder's.
    pub fn png(&self) -> Result<Vec<u8>, UltrasoundError> {
        png(self.grid(), self.pixels())
    }

    /// A NIfTI-1 file (u8, one plane) with the slice's pose, so that 3D Slicer shows it in place.
    pub fn nifti(&self) -> Vec<u8> {
        let g = self.grid();
        let affine = g.affine(&self.pose, thickness(self.scanner.probe()));
        let what = match self.scanner.settings().level {
            Level::Slice | Level::Grey => "CT as grey",
            Level::Rays => "ray model",
            Level::BMode => "B-mode",
        };
        let what = format!(
            "{what}; grey values and stiffness are not calibrated{}",
            nominal(self.scanner)
        );
        encode(
            g.width_px,
            g.height_px,
            &affine,
            &Voxels::U8(self.pixels()),
            &what,
        )
    }

    /// Level, probe, pose, what was nominal, inverted tets, pixels that the mesh did not cover.
    pub fn metadata(&self) -> Metadata {
        let mut out = metadata(
            self.scanner,
            self.scanner.settings().level,
            &self.pose,
            self.inverted_tets(),
            self.source_counts(),
        );
        let grey =
            "grey values are not calibrated: compare them within an image, do not read them as measurements";
        out.notes.insert(0, grey.into());
        out
    }
}

impl SliceImage<'_> {
    /// A NIfTI-1 file of the CT values (f32, HU, one plane) with the slice's pose.
    pub fn nifti(&self) -> Vec<u8> {
        let g = self.grid();
        let affine = g.affine(&self.pose, thickness(self.scanner.probe()));
        let what = format!(
            "CT values, HU; stiffness is not calibrated{}",
            nominal(self.scanner)
        );
        encode(g.width_px, g.height_px, &affine, &Voxels::F32(self.hu()), &what)
    }

    /// A NIfTI-1 file of the label codes (u16, one plane) with the slice's pose.
    pub fn label_nifti(&self) -> Vec<u8> {
        let g = self.grid();
        let affine = g.affine(&self.pose, thickness(self.scanner.probe()));
        let voxels = Voxels::U16(self.labels());
        encode(
            g.width_px,
            g.height_px,
            &affine,
            &voxels,
            "label codes; stiffness is not calibrated",
        )
    }

    /// As [`Image::metadata`], of the level 0 image.
    pub fn metadata(&self) -> Metadata {
        metadata(
            self.scanner,
            Level::Slice,
            &self.pose,
            self.inverted_tets(),
            self.source_counts(),
        )
    }
}

impl Metadata {
    /// Indented JSON.
    ///
    /// # Errors
    /// The encoder's.
    pub fn json(&self) -> Result<String, UltrasoundError> {
        Ok(serde_json::to_string_pretty(self)?)
    }
}
