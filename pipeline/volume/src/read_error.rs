use crate::nifti_io::AffineSource;
use std::io;

/// Why a file could not be read: the cause, then the file.
#[derive(Debug)]
pub struct ReadError {
    /// What is wrong.
    pub fault: Box<ReadFault>,
    /// The file as the caller named it.
    pub file: String,
}

impl ReadError {
    pub(crate) fn new(fault: ReadFault, file: &str) -> Self {
        Self {
            fault: Box::new(fault),
            file: file.to_owned(),
        }
    }
}

impl std::fmt::Display for ReadError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {}", self.fault, self.file)
    }
}

impl std::error::Error for ReadError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        std::error::Error::source(&*self.fault)
    }
}

/// One cause each: what was found, what was expected, what to do.
#[derive(Debug, thiserror::Error)]
pub enum ReadFault {
    /// The operating system refused.
    #[error("the file cannot be read")]
    Io(#[source] io::Error),
    /// The first bytes are no NIfTI header.
    #[error("not a NIfTI file: {found}; export the labels as .nii or .nii.gz")]
    NotNifti {
        /// What the bytes look like.
        found: String,
    },
    /// Header of an `.hdr`/`.img` pair.
    #[error(
        "the header belongs to a .hdr/.img pair (magic {magic:?}), which is not read; convert the pair to a single .nii file"
    )]
    Paired {
        /// `ni1` or `ni2`.
        magic: &'static str,
    },
    /// The file ends inside the header.
    #[error("the file is cut off: its header needs {need} bytes, {have} are there")]
    TruncatedHeader {
        /// Bytes found.
        have: u64,
        /// Bytes of a whole header.
        need: u64,
    },
    /// Fewer voxel bytes than the header says.
    #[error(
        "the file is cut off: its header says {need} bytes of voxels, {have} are there; copy or export it again"
    )]
    Truncated {
        /// Bytes of voxels found.
        have: u64,
        /// Bytes of voxels that the header says.
        need: u64,
    },
    /// The gzip stream ends early.
    #[error("the gzip stream is cut off after {have} unpacked bytes; copy or export the file again")]
    TruncatedGzip {
        /// Bytes unpacked before the end.
        have: u64,
    },
    /// The gzip stream is damaged.
    #[error("the gzip stream is damaged after {have} unpacked bytes ({what}); copy or export the file again")]
    CorruptGzip {
        /// Bytes unpacked before the damage showed.
        have: u64,
        /// What does not fit.
        what: &'static str,
    },
    /// The gzip checksum does not match.
    #[error(
        "the gzip checksum is wrong (stored {stored:08x}, computed {computed:08x}): the file is damaged; copy or export it again"
    )]
    Checksum {
        /// CRC-32 in the file.
        stored: u32,
        /// CRC-32 of what was unpacked.
        computed: u32,
    },
    /// A dimension is zero, negative, or their number is not 1 to 7.
    #[error(
        "the header's dimensions {dim:?} are not valid (number of axes 1 to 7, then sizes of at least 1)"
    )]
    BadDims {
        /// `dim[0..=7]` as stored.
        dim: [i64; 8],
    },
    /// More than one volume.
    #[error(
        "the file holds {volumes} volumes (dimensions {dim:?}); export the one that is meant as a 3-D file"
    )]
    ManyVolumes {
        /// Product of the fourth to last dimension.
        volumes: u64,
        /// The dimensions in use.
        dim: Vec<i64>,
    },
    /// More voxels than is sane.
    #[error(
        "the header claims {dims:?} voxels, more than the limit of {limit} in all; the header is damaged"
    )]
    TooManyVoxels {
        /// As the header says.
        dims: [i64; 3],
        /// Most voxels that are read.
        limit: u64,
    },
    /// A gzip file of this size cannot unpack to what the header claims.
    #[error(
        "the header claims {need} bytes, but a gzip file of {packed} bytes unpacks to no more than {most}: the file is cut off or its header damaged"
    )]
    ClaimsTooMuch {
        /// Bytes up to the last voxel.
        need: u64,
        /// Size of the compressed file.
        packed: u64,
        /// The most that it can hold.
        most: u64,
    },
    /// Voxels of a type that is not read.
    #[error(
        "voxels of type {name} (datatype {code}) are not read; export whole numbers (8 to 64 bit) or real floats"
    )]
    UnsupportedType {
        /// NIfTI datatype code.
        code: i64,
        /// Its name.
        name: &'static str,
    },
    /// The offset to the voxels is impossible.
    #[error(
        "the header says that voxels start at byte {offset}; expected a whole number of at least {least}"
    )]
    BadOffset {
        /// `vox_offset`.
        offset: f64,
        /// End of the header.
        least: u64,
    },
    /// The affine has a value that is not finite.
    #[error(
        "the {from} holds a value that is not finite ({m:?}); set the image's orientation again and export it"
    )]
    NonFiniteAffine {
        /// Where the affine stands in the header.
        from: AffineSource,
        /// Its rows.
        m: [[f64; 4]; 3],
    },
    /// The affine flattens the volume.
    #[error(
        "the {from} is singular ({m:?}): voxels have no volume; set the image's orientation again and export it"
    )]
    SingularAffine {
        /// Where the affine stands in the header.
        from: AffineSource,
        /// Its rows.
        m: [[f64; 4]; 3],
    },
    /// Labels with a scale.
    #[error(
        "the voxels are scaled (slope {slope}, intercept {inter}), labels must not be: this looks like an intensity image; if it is a label map, export it unscaled"
    )]
    Scaled {
        /// `scl_slope`.
        slope: f64,
        /// `scl_inter`.
        inter: f64,
    },
    /// A float voxel that is no label.
    #[error(
        "voxel {index:?} holds {value}, which is not a whole number: this looks like an intensity image; give it with the option for CT intensities, or export labels with nearest-neighbour resampling"
    )]
    NotWhole {
        /// Voxel (i, j, k).
        index: [usize; 3],
        /// Its value.
        value: f64,
    },
    /// A voxel value that does not fit a label.
    #[error("voxel {index:?} holds {value}; labels must lie within ±2^53")]
    LabelTooLarge {
        /// Voxel (i, j, k).
        index: [usize; 3],
        /// Its value.
        value: f64,
    },
    /// Voxels vary as intensities do.
    #[error(
        "this looks like an intensity image, not a label map: {distinct} distinct values from {min} to {max}, and {changed_percent:.0} % of voxels differ from their neighbour; give it with the option for CT intensities"
    )]
    Intensities {
        /// Number of distinct values; counting ends at 65 536.
        distinct: Distinct,
        /// Smallest value.
        min: i64,
        /// Largest value.
        max: i64,
        /// Share of voxels that differ from the one before, in percent.
        changed_percent: f64,
    },
    /// A label map with more labels than a byte can number.
    #[error(
        "the label map holds {distinct} distinct values from {min} to {max}, at most 255 besides the background 0 are read; export only the labels that are needed"
    )]
    TooManyLabels {
        /// Number of distinct values; counting ends at 65 536.
        distinct: Distinct,
        /// Smallest value.
        min: i64,
        /// Largest value.
        max: i64,
    },
    /// Not enough memory.
    #[error("{bytes} bytes of memory are needed and not available")]
    OutOfMemory {
        /// Bytes asked for.
        bytes: u64,
    },
    /// CT and labels lie apart.
    #[error(
        "the CT does not overlap the labels: CT {ct}, labels {target} (patient RAS mm); is it the same patient and scan?"
    )]
    NoOverlap {
        /// Box of the CT.
        ct: PatientBox,
        /// Box of the label crop.
        target: PatientBox,
    },
}

/// A count that ends at a limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Distinct {
    /// All were counted.
    Exactly(usize),
    /// Counting ended here.
    MoreThan(usize),
}

impl std::fmt::Display for Distinct {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Exactly(n) => write!(f, "{n}"),
            Self::MoreThan(n) => write!(f, "more than {n}"),
        }
    }
}

/// An axis-aligned box in patient RAS mm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PatientBox {
    /// Smallest R, A, S.
    pub min_mm: [f64; 3],
    /// Largest R, A, S.
    pub max_mm: [f64; 3],
}

impl std::fmt::Display for PatientBox {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (a, b) = (self.min_mm, self.max_mm);
        write!(
            f,
            "R {:.1}…{:.1}, A {:.1}…{:.1}, S {:.1}…{:.1}",
            a[0], b[0], a[1], b[1], a[2], b[2]
        )
    }
}
