use super::{AffineSource, ReadWarning};
use crate::{Affine, ReadFault};
use nifti::NiftiHeader;

/// Bytes of a NIfTI-1 header.
pub(crate) const SIZE_1: usize = 348;
/// Bytes of a NIfTI-2 header.
pub(crate) const SIZE_2: usize = 540;

/// Which header a file starts with, from its first four bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Kind {
    pub(crate) nifti2: bool,
    pub(crate) big_endian: bool,
}

impl Kind {
    pub(crate) fn detect(first: [u8; 4]) -> Option<Self> {
        [(false, SIZE_1), (true, SIZE_2)]
            .into_iter()
            .find_map(|(nifti2, size)| {
                let size = size as u32;
                [(false, size.to_le_bytes()), (true, size.to_be_bytes())]
                    .into_iter()
                    .find_map(|(big_endian, bytes)| (bytes == first).then_some(Self { nifti2, big_endian }))
            })
    }

    pub(crate) fn size(self) -> usize {
        if self.nifti2 { SIZE_2 } else { SIZE_1 }
    }
}

/// Voxel types that are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum VoxelType {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

impl VoxelType {
    fn from_code(code: i64) -> Result<Self, ReadFault> {
        let unsupported = |name| Err(ReadFault::UnsupportedType { code, name });
        match code {
            2 => Ok(Self::U8),
            256 => Ok(Self::I8),
            512 => Ok(Self::U16),
            4 => Ok(Self::I16),
            768 => Ok(Self::U32),
            8 => Ok(Self::I32),
            1280 => Ok(Self::U64),
            1024 => Ok(Self::I64),
            16 => Ok(Self::F32),
            64 => Ok(Self::F64),
            0 => unsupported("unknown"),
            1 => unsupported("1-bit binary"),
            32 => unsupported("complex (2 × 32-bit float)"),
            1792 => unsupported("complex (2 × 64-bit float)"),
            2048 => unsupported("complex (2 × 128-bit float)"),
            128 => unsupported("RGB colour"),
            2304 => unsupported("RGBA colour"),
            1536 => unsupported("128-bit float"),
            _ => unsupported("not in the NIfTI standard"),
        }
    }

    pub(crate) fn bytes(self) -> usize {
        match self {
            Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::U8 => "u8",
            Self::I8 => "i8",
            Self::U16 => "u16",
            Self::I16 => "i16",
            Self::U32 => "u32",
            Self::I32 => "i32",
            Self::U64 => "u64",
            Self::I64 => "i64",
            Self::F32 => "f32",
            Self::F64 => "f64",
        }
    }
}

/// What the reader needs to know, checked.
#[derive(Clone, Debug)]
pub(crate) struct Header {
    pub(crate) kind: Kind,
    pub(crate) dims: [usize; 3],
    pub(crate) voxel: VoxelType,
    /// Byte of the first voxel.
    pub(crate) offset: u64,
    /// Slope and intercept where they change anything.
    pub(crate) scale: Option<(f64, f64)>,
    pub(crate) affine: Affine,
    pub(crate) affine_source: AffineSource,
    pub(crate) warnings: Vec<ReadWarning>,
}

/// The fields of either header, as stored.
struct Fields {
    dim: [i64; 8],
    datatype: i64,
    bitpix: i64,
    pixdim: [f64; 8],
    offset: f64,
    slope: f64,
    inter: f64,
    units: u8,
    qform_code: i64,
    sform_code: i64,
    quatern: [f64; 3],
    qoffset: [f64; 3],
    srow: [[f64; 4]; 3],
}

impl Header {
    /// Checks a header; `bytes` has at least `kind.size()` bytes.
    pub(crate) fn parse(kind: Kind, bytes: &[u8], most_voxels: u64) -> Result<Self, ReadFault> {
        check_magic(kind, bytes)?;
        let f = if kind.nifti2 {
            fields_2(kind, bytes)
        } else {
            fields_1(kind, bytes)?
        };
        let mut warnings = Vec::new();
        let dims = checked_dims(&f.dim, most_voxels)?;
        let voxel = VoxelType::from_code(f.datatype)?;
        if f.bitpix != 8 * voxel.bytes() as i64 {
            warnings.push(ReadWarning::BitsPerVoxel {
                found: f.bitpix,
                expected: 8 * voxel.bytes() as i64,
            });
        }
        // The four bytes after the header say whether extensions follow.
        let least = kind.size() as u64 + 4;
        let offset = if f.offset == 0.0 {
            warnings.push(ReadWarning::NoOffset { assumed: least });
            least
        } else if f.offset >= least as f64 && f.offset < 2f64.powi(53) && f.offset.fract() == 0.0 {
            f.offset as u64
        } else {
            return Err(ReadFault::BadOffset {
                offset: f.offset,
                least,
            });
        };
        let (affine, affine_source) = checked_affine(&f, dims, &mut warnings)?;
        Ok(Self {
            kind,
            dims,
            voxel,
            offset,
            scale: scale(f.slope, f.inter),
            affine,
            affine_source,
            warnings,
        })
    }

    pub(crate) fn voxels(&self) -> u64 {
        self.dims.iter().map(|&d| d as u64).product()
    }

    pub(crate) fn data_bytes(&self) -> u64 {
        self.voxels() * self.voxel.bytes() as u64
    }
}

fn check_magic(kind: Kind, bytes: &[u8]) -> Result<(), ReadFault> {
    let magic: &[u8] = if kind.nifti2 {
        &bytes[4..12]
    } else {
        &bytes[344..348]
    };
    match (kind.nifti2, magic) {
        (false, b"n+1\0") | (true, b"n+2\0\r\n\x1a\n") => Ok(()),
        (false, b"ni1\0") => Err(ReadFault::Paired { magic: "ni1" }),
        (true, [b'n', b'i', b'2', ..]) => Err(ReadFault::Paired { magic: "ni2" }),
        (false, _) => Err(not_nifti(
            "an ANALYZE 7.5 header or a NIfTI-1 header with a damaged magic",
        )),
        (true, _) => Err(not_nifti(
            "a NIfTI-2 header with a damaged magic (was it transferred as text?)",
        )),
    }
}

pub(crate) fn not_nifti(found: &str) -> ReadFault {
    ReadFault::NotNifti {
        found: found.to_owned(),
    }
}

fn fields_1(kind: Kind, bytes: &[u8]) -> Result<Fields, ReadFault> {
    let get = Getter {
        bytes,
        big_endian: kind.big_endian,
    };
    let dim: [i64; 8] = std::array::from_fn(|n| i64::from(i16::from_le_bytes(get.at(40 + 2 * n))));
    // The crate tells the byte order from dim[0] alone.
    if !(1..=7).contains(&dim[0]) {
        return Err(ReadFault::BadDims { dim });
    }
    let h = NiftiHeader::from_reader(bytes).map_err(|_| not_nifti("a damaged NIfTI-1 header"))?;
    let wide = |v: f32| f64::from(v);
    Ok(Fields {
        dim,
        datatype: h.datatype.into(),
        bitpix: h.bitpix.into(),
        pixdim: h.pixdim.map(wide),
        offset: h.vox_offset.into(),
        slope: h.scl_slope.into(),
        inter: h.scl_inter.into(),
        units: h.xyzt_units,
        qform_code: h.qform_code.into(),
        sform_code: h.sform_code.into(),
        quatern: [h.quatern_b, h.quatern_c, h.quatern_d].map(wide),
        qoffset: [h.quatern_x, h.quatern_y, h.quatern_z].map(wide),
        srow: [h.srow_x, h.srow_y, h.srow_z].map(|row| row.map(wide)),
    })
}

fn fields_2(kind: Kind, bytes: &[u8]) -> Fields {
    let get = Getter {
        bytes,
        big_endian: kind.big_endian,
    };
    let i16_at = |o| i64::from(i16::from_le_bytes(get.at(o)));
    let i32_at = |o| i64::from(i32::from_le_bytes(get.at(o)));
    let i64_at = |o| i64::from_le_bytes(get.at(o));
    let f64_at = |o| f64::from_le_bytes(get.at(o));
    Fields {
        dim: std::array::from_fn(|n| i64_at(16 + 8 * n)),
        datatype: i16_at(12),
        bitpix: i16_at(14),
        pixdim: std::array::from_fn(|n| f64_at(104 + 8 * n)),
        offset: i64_at(168) as f64,
        slope: f64_at(176),
        inter: f64_at(184),
        units: i32_at(500) as u8,
        qform_code: i32_at(344),
        sform_code: i32_at(348),
        quatern: std::array::from_fn(|n| f64_at(352 + 8 * n)),
        qoffset: std::array::from_fn(|n| f64_at(376 + 8 * n)),
        srow: std::array::from_fn(|r| std::array::from_fn(|c| f64_at(400 + 32 * r + 8 * c))),
    }
}

struct Getter<'a> {
    bytes: &'a [u8],
    big_endian: bool,
}

impl Getter<'_> {
    /// Bytes in little-endian order; zeros past the end.
    fn at<const N: usize>(&self, offset: usize) -> [u8; N] {
        let mut out = [0; N];
        if let Some(from) = self.bytes.get(offset..offset + N) {
            out.copy_from_slice(from);
        }
        if self.big_endian {
            out.reverse();
        }
        out
    }
}

fn checked_dims(dim: &[i64; 8], most_voxels: u64) -> Result<[usize; 3], ReadFault> {
    if !(1..=7).contains(&dim[0]) {
        return Err(ReadFault::BadDims { dim: *dim });
    }
    let used = &dim[1..=dim[0] as usize];
    if used.iter().any(|&d| d < 1) {
        return Err(ReadFault::BadDims { dim: *dim });
    }
    let volumes = used.iter().skip(3).fold(1u64, |n, &d| n.saturating_mul(d as u64));
    if volumes != 1 {
        return Err(ReadFault::ManyVolumes {
            volumes,
            dim: used.to_vec(),
        });
    }
    let dims: [i64; 3] = std::array::from_fn(|a| used.get(a).copied().unwrap_or(1));
    let voxels = dims.iter().try_fold(1u64, |n, &d| n.checked_mul(d as u64));
    if voxels.is_none_or(|v| v > most_voxels) {
        return Err(ReadFault::TooManyVoxels {
            dims,
            limit: most_voxels,
        });
    }
    Ok(dims.map(|d| d as usize))
}

/// The header's scale where it is set and is not the identity. Slope 0 or NaN means "not scaled".
fn scale(slope: f64, inter: f64) -> Option<(f64, f64)> {
    let inter = if inter.is_nan() { 0.0 } else { inter };
    (slope != 0.0 && !slope.is_nan() && (slope, inter) != (1.0, 0.0)).then_some((slope, inter))
}

/// The affine by the standard's order (sform, qform, voxel sizes), in mm.
fn checked_affine(
    f: &Fields,
    dims: [usize; 3],
    warnings: &mut Vec<ReadWarning>,
) -> Result<(Affine, AffineSource), ReadFault> {
    let to_mm = match f.units & 7 {
        1 => 1e3,
        2 => 1.0,
        3 => 1e-3,
        other => {
            warnings.push(ReadWarning::UnknownUnit { code: other });
            1.0
        }
    };
    let mm = |m: [[f64; 4]; 3]| Affine {
        m: m.map(|row| row.map(|v| v * to_mm)),
    };
    let sform = (f.sform_code > 0).then(|| mm(f.srow));
    let qform = (f.qform_code > 0).then(|| mm(qform_rows(f)));
    let (affine, source) = match (sform, qform) {
        (Some(s), _) => (s, AffineSource::Sform),
        (None, Some(q)) => (q, AffineSource::Qform),
        (None, None) => {
            warnings.push(ReadWarning::NoOrientation);
            (mm(voxel_size_rows(f)), AffineSource::VoxelSizes)
        }
    };
    if !affine.m.iter().flatten().all(|v| v.is_finite()) {
        return Err(ReadFault::NonFiniteAffine {
            from: source,
            m: affine.m,
        });
    }
    if affine.inverse().is_none() {
        return Err(ReadFault::SingularAffine {
            from: source,
            m: affine.m,
        });
    }
    if let (Some(s), Some(q)) = (sform, qform) {
        let off = largest_corner_distance(&s, &q, dims);
        // A qform that is not finite differs too.
        if !off.is_finite() || off > 1e-3 {
            warnings.push(ReadWarning::FormsDiffer { by_mm: off });
        }
    }
    let spacing = affine.spacing_mm();
    if spacing.iter().any(|s| !(0.01..=50.0).contains(s)) {
        warnings.push(ReadWarning::OddSpacing { spacing_mm: spacing });
    }
    Ok((affine, source))
}

/// Voxel sizes alone: no offset, no orientation.
fn voxel_size_rows(f: &Fields) -> [[f64; 4]; 3] {
    let mut m = [[0.0; 4]; 3];
    for a in 0..3 {
        m[a][a] = axis_size(f, a);
    }
    m
}

/// Voxel size of an axis; axes that the file does not have need none.
fn axis_size(f: &Fields, axis: usize) -> f64 {
    let size = f.pixdim[axis + 1].abs();
    if size == 0.0 && f.dim[0] <= axis as i64 {
        1.0
    } else {
        size
    }
}

fn qform_rows(f: &Fields) -> [[f64; 4]; 3] {
    let [mut b, mut c, mut d] = f.quatern;
    let rest = 1.0 - (b * b + c * c + d * d);
    let a = if rest < 1e-7 {
        let norm = (b * b + c * c + d * d).sqrt();
        (b, c, d) = (b / norm, c / norm, d / norm);
        0.0
    } else {
        rest.sqrt()
    };
    let r = [
        [
            a * a + b * b - c * c - d * d,
            2.0 * (b * c - a * d),
            2.0 * (b * d + a * c),
        ],
        [
            2.0 * (b * c + a * d),
            a * a + c * c - b * b - d * d,
            2.0 * (c * d - a * b),
        ],
        [
            2.0 * (b * d - a * c),
            2.0 * (c * d + a * b),
            a * a + d * d - b * b - c * c,
        ],
    ];
    let qfac = if f.pixdim[0] < 0.0 { -1.0 } else { 1.0 };
    let size = [axis_size(f, 0), axis_size(f, 1), qfac * axis_size(f, 2)];
    std::array::from_fn(|row| {
        [
            r[row][0] * size[0],
            r[row][1] * size[1],
            r[row][2] * size[2],
            f.qoffset[row],
        ]
    })
}

fn largest_corner_distance(a: &Affine, b: &Affine, dims: [usize; 3]) -> f64 {
    let mut most = 0.0f64;
    for corner in 0..8 {
        let p = std::array::from_fn(|axis| {
            if corner >> axis & 1 == 1 {
                (dims[axis] - 1) as f64
            } else {
                0.0
            }
        });
        let (u, v) = (a.apply(p), b.apply(p));
        let d = (0..3).map(|r| (u[r] - v[r]).powi(2)).sum::<f64>().sqrt();
        most = if d.is_nan() { f64::INFINITY } else { most.max(d) };
    }
    most
}
