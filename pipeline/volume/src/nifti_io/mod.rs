mod codes;
mod gzip;
mod header;
mod stream;
mod values;

use crate::{Affine, LabelVolume, ReadError, ReadFault};
use codes::Coder;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

pub(crate) use stream::VoxelStream;
pub(crate) use values::each_value;

/// Which of the header's coordinate methods gave the affine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AffineSource {
    /// The affine rows (method 3).
    Sform,
    /// Quaternion and offset (method 2).
    Qform,
    /// Voxel sizes alone, without offset and orientation (method 1).
    VoxelSizes,
}

impl std::fmt::Display for AffineSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Sform => "sform",
            Self::Qform => "qform",
            Self::VoxelSizes => "voxel size",
        })
    }
}

/// Something odd that did not stop the reading.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, thiserror::Error)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum ReadWarning {
    /// Neither sform nor qform is set.
    #[error(
        "the header has no orientation (sform and qform codes are 0): left and right are not known, axes are taken as R, A, S"
    )]
    NoOrientation,
    /// sform and qform put the volume in different places.
    #[error("sform and qform differ by up to {by_mm:.3} mm; the sform is used")]
    FormsDiffer {
        /// Largest distance over the volume's corners; infinite where the qform is not finite.
        by_mm: f64,
    },
    /// The unit of length is not given.
    #[error("the header names no known unit of length (code {code}); millimetres are assumed")]
    UnknownUnit {
        /// Low three bits of `xyzt_units`.
        code: u8,
    },
    /// Voxels smaller than 0.01 mm or larger than 50 mm.
    #[error("voxels of {spacing_mm:?} mm are unusual; is the unit of length right?")]
    OddSpacing {
        /// Along the index axes.
        spacing_mm: [f64; 3],
    },
    /// `bitpix` does not fit `datatype`.
    #[error("the header says {found} bits per voxel, its datatype has {expected}; the datatype is used")]
    BitsPerVoxel {
        /// `bitpix`.
        found: i64,
        /// Of the datatype.
        expected: i64,
    },
    /// `vox_offset` is 0.
    #[error("the header does not say where voxels start; byte {assumed} is assumed")]
    NoOffset {
        /// First byte after the header and its extension flag.
        assumed: u64,
    },
    /// Data after the last voxel.
    #[error("{bytes} bytes after the last voxel are ignored")]
    TrailingBytes {
        /// Unpacked bytes.
        bytes: u64,
    },
    /// So much after the last voxel that it was not unpacked, and the gzip checksum not compared.
    #[error(
        "more than {at_least} bytes follow the last voxel; they are ignored and the checksum was not compared"
    )]
    TrailingUnchecked {
        /// Unpacked bytes seen.
        at_least: u64,
    },
    /// Bytes after the last gzip member.
    #[error("bytes after the end of the gzip stream are ignored")]
    GarbageAfterGzip,
    /// Part of the label crop lies outside of the CT.
    #[error("{percent:.1} % of the label crop lies outside of the CT and is taken as air")]
    PartlyOutsideCt {
        /// Share of the crop's voxels.
        percent: f64,
    },
    /// CT voxels that are not finite.
    #[error("{voxels} CT voxels are not finite numbers and are taken as air")]
    NotFinite {
        /// How many.
        voxels: u64,
    },
}

/// What was read and how it was understood.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReadReport {
    /// The file as the caller named it.
    pub file: String,
    /// `NIfTI-1` or `NIfTI-2`.
    pub format: String,
    /// Whether it was packed with gzip.
    pub compressed: bool,
    /// Whether it was stored in big-endian order.
    pub big_endian: bool,
    /// Voxel type, for example `u8` or `f32`.
    pub voxel_type: String,
    /// Voxels along the file's index axes.
    pub dims: [usize; 3],
    /// Voxel distance along the index axes.
    pub spacing_mm: [f64; 3],
    /// Index → patient RAS mm of the file.
    pub affine: Affine,
    /// Where the affine comes from.
    pub affine_source: AffineSource,
    /// How intensities came onto the label grid; `None` for labels.
    pub placement: Option<CtPlacement>,
    /// What was odd.
    pub warnings: Vec<ReadWarning>,
}

/// How intensities came onto the label grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum CtPlacement {
    /// The grids coincide: voxels are copied.
    Copied {
        /// Index in the CT of the crop's voxel (0, 0, 0).
        start: [i64; 3],
    },
    /// Trilinear interpolation by world position.
    Interpolated,
}

/// What a reader takes on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReadLimits {
    /// Most voxels; a header that claims more is refused before memory is asked for.
    pub voxels: u64,
}

impl Default for ReadLimits {
    /// 2^40 voxels: far above any scan, far below what a damaged header claims.
    fn default() -> Self {
        Self { voxels: 1 << 40 }
    }
}

/// Reads a label map from a NIfTI-1 or NIfTI-2 single file, packed with gzip or not (told by its first bytes).
///
/// `progress` is called with the share done, 0 to 1. Peak memory is one byte per voxel, less where the scan is mostly
/// background.
///
/// # Errors
/// Every cause is a [`ReadFault`].
pub fn read_labels(
    path: impl AsRef<Path>,
    progress: &dyn Fn(f64),
) -> Result<(LabelVolume, ReadReport), ReadError> {
    let path = path.as_ref();
    let name = path.display().to_string();
    with_file(path, |reader, len| {
        labels(reader, len, &name, &ReadLimits::default(), progress)
    })
    .map_err(|fault| ReadError::new(fault, &name))
}

/// Reads a label map from the bytes of a file that is in memory; `name` stands for the file in report and errors.
///
/// # Errors
/// As [`read_labels`].
pub fn read_labels_from(
    bytes: &[u8],
    name: &str,
    limits: &ReadLimits,
    progress: &dyn Fn(f64),
) -> Result<(LabelVolume, ReadReport), ReadError> {
    labels(bytes, bytes.len() as u64, name, limits, progress).map_err(|fault| ReadError::new(fault, name))
}

/// Opens `path` for `read` with its length; what is no regular file (a pipe) is taken into memory first.
pub(crate) fn with_file<T>(
    path: &Path,
    read: impl FnOnce(Box<dyn BufRead>, u64) -> Result<T, ReadFault>,
) -> Result<T, ReadFault> {
    let mut file = File::open(path).map_err(ReadFault::Io)?;
    let meta = file.metadata().map_err(ReadFault::Io)?;
    if meta.is_file() {
        return read(Box::new(BufReader::with_capacity(1 << 16, file)), meta.len());
    }
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes).map_err(ReadFault::Io)?;
    let len = bytes.len() as u64;
    read(Box::new(std::io::Cursor::new(bytes)), len)
}

fn labels<R: BufRead>(
    reader: R,
    len: u64,
    name: &str,
    limits: &ReadLimits,
    progress: &dyn Fn(f64),
) -> Result<(LabelVolume, ReadReport), ReadFault> {
    let mut stream = VoxelStream::open(reader, len, limits)?;
    if let Some((slope, inter)) = stream.header.scale {
        return Err(ReadFault::Scaled { slope, inter });
    }
    let mut coder = Coder::new(&stream.header)?;
    while let Some((first, bytes)) = stream.next_chunk()? {
        coder.add(first, bytes)?;
        progress(stream.progress());
    }
    let affine = stream.header.affine;
    let mut report = report(&stream, name);
    report.warnings = stream.finish()?;
    let volume = coder.finish(affine)?;
    Ok((volume, report))
}

pub(crate) fn report<R>(stream: &VoxelStream<R>, file: &str) -> ReadReport {
    let h = &stream.header;
    ReadReport {
        file: file.to_owned(),
        format: if h.kind.nifti2 { "NIfTI-2" } else { "NIfTI-1" }.to_owned(),
        compressed: stream.compressed,
        big_endian: h.kind.big_endian,
        voxel_type: h.voxel.name().to_owned(),
        dims: h.dims,
        spacing_mm: h.affine.spacing_mm(),
        affine: h.affine,
        affine_source: h.affine_source,
        placement: None,
        warnings: Vec::new(),
    }
}

/// A vector of `len` times `value` whose memory is asked for first, so that too much is an error and not an abort.
pub(crate) fn filled<T: Clone>(value: T, len: usize) -> Result<Vec<T>, ReadFault> {
    let mut asked: Vec<T> = Vec::new();
    asked.try_reserve_exact(len).map_err(|_| ReadFault::OutOfMemory {
        bytes: (len as u64).saturating_mul(size_of::<T>() as u64),
    })?;
    drop(asked);
    // Allocated anew because only this way are pages of zeros made by the system, when they are first touched.
    Ok(vec![value; len])
}
