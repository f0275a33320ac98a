use super::gzip::{GzipReader, MOST_EXPANSION};
use super::header::{Header, Kind, SIZE_1, SIZE_2, not_nifti};
use super::{ReadLimits, ReadWarning};
use crate::ReadFault;
use std::io::BufRead;

/// Bytes that are unpacked at a time: small enough to stay in the processor's cache until they are converted.
const CHUNK: usize = 256 * 1024;
/// What may follow the voxels before reading ends unchecked.
const MOST_TRAILING: u64 = 1 << 20;

enum Source<R> {
    Plain(R),
    Gzip(Box<GzipReader<R>>),
}

impl<R: BufRead> Source<R> {
    /// Fills `out` unless the data end earlier; the number of bytes filled.
    fn fill(&mut self, out: &mut [u8]) -> Result<usize, ReadFault> {
        let mut have = 0;
        while have < out.len() {
            let n = match self {
                Self::Plain(r) => match r.read(&mut out[have..]) {
                    Err(e) if e.kind() == std::io::ErrorKind::Interrupted => continue,
                    other => other.map_err(ReadFault::Io)?,
                },
                Self::Gzip(z) => z.read(&mut out[have..])?,
            };
            if n == 0 {
                break;
            }
            have += n;
        }
        Ok(have)
    }
}

/// The voxels of a NIfTI file, chunk by chunk in file order.
pub(crate) struct VoxelStream<R> {
    source: Source<R>,
    pub(crate) header: Header,
    pub(crate) compressed: bool,
    /// Bytes in the file, packed.
    file_bytes: u64,
    done: u64,
    chunk: Vec<u8>,
}

impl<R: BufRead> VoxelStream<R> {
    /// Reads and checks the header and goes to the first voxel. `file_bytes`: what `reader` holds in all.
    pub(crate) fn open(mut reader: R, file_bytes: u64, limits: &ReadLimits) -> Result<Self, ReadFault> {
        let compressed = reader
            .fill_buf()
            .map_err(ReadFault::Io)?
            .starts_with(&[0x1f, 0x8b]);
        let mut source = if compressed {
            Source::Gzip(Box::new(GzipReader::new(reader)?))
        } else {
            Source::Plain(reader)
        };
        let mut bytes = [0; SIZE_2];
        let mut have = source.fill(&mut bytes[..SIZE_1])?;
        let kind = Kind::detect([bytes[0], bytes[1], bytes[2], bytes[3]])
            .filter(|_| have >= 4)
            .ok_or_else(|| not_nifti(&looks_like(&bytes[..have], compressed)))?;
        if kind.nifti2 && have == SIZE_1 {
            have += source.fill(&mut bytes[SIZE_1..])?;
        }
        if have < kind.size() {
            return Err(ReadFault::TruncatedHeader {
                have: have as u64,
                need: kind.size() as u64,
            });
        }
        let header = Header::parse(kind, &bytes, limits.voxels)?;
        // Before anything is allocated for the voxels: can the file hold what its header claims?
        let need = header.offset.saturating_add(header.data_bytes());
        if compressed {
            let most = file_bytes.saturating_mul(MOST_EXPANSION);
            if need > most {
                return Err(ReadFault::ClaimsTooMuch {
                    need,
                    packed: file_bytes,
                    most,
                });
            }
        } else if need > file_bytes {
            let have = file_bytes.saturating_sub(header.offset);
            return Err(ReadFault::Truncated {
                have,
                need: header.data_bytes(),
            });
        }
        let mut chunk = vec![0; CHUNK];
        let mut skip = header.offset - kind.size() as u64;
        while skip > 0 {
            let part = skip.min(CHUNK as u64) as usize;
            if source.fill(&mut chunk[..part])? < part {
                return Err(ReadFault::Truncated {
                    have: 0,
                    need: header.data_bytes(),
                });
            }
            skip -= part as u64;
        }
        Ok(Self {
            source,
            header,
            compressed,
            file_bytes,
            done: 0,
            chunk,
        })
    }

    /// The next voxels' bytes (whole voxels) with the first one's number, or `None` after the last.
    pub(crate) fn next_chunk(&mut self) -> Result<Option<(usize, &[u8])>, ReadFault> {
        let total = self.header.data_bytes();
        let part = (total - self.done).min(CHUNK as u64) as usize;
        if part == 0 {
            return Ok(None);
        }
        let have = self.source.fill(&mut self.chunk[..part])?;
        if have < part {
            return Err(ReadFault::Truncated {
                have: self.done + have as u64,
                need: total,
            });
        }
        let first = (self.done / self.header.voxel.bytes() as u64) as usize;
        self.done += part as u64;
        Ok(Some((first, &self.chunk[..part])))
    }

    /// Share of the voxels that has passed, 0 to 1.
    pub(crate) fn progress(&self) -> f64 {
        self.done as f64 / self.header.data_bytes() as f64
    }

    /// After the last voxel: checks the end of the file and returns all warnings.
    pub(crate) fn finish(mut self) -> Result<Vec<ReadWarning>, ReadFault> {
        let mut warnings = std::mem::take(&mut self.header.warnings);
        if !self.compressed {
            let end = self.header.offset + self.header.data_bytes();
            if self.file_bytes > end {
                warnings.push(ReadWarning::TrailingBytes {
                    bytes: self.file_bytes - end,
                });
            }
            return Ok(warnings);
        }
        // The checksum stands after the last unpacked byte, so what trails is unpacked too, within reason.
        let mut trailing = 0;
        loop {
            let have = self.source.fill(&mut self.chunk)? as u64;
            trailing += have;
            if have < CHUNK as u64 {
                if trailing > 0 {
                    warnings.push(ReadWarning::TrailingBytes { bytes: trailing });
                }
                break;
            }
            if trailing >= MOST_TRAILING {
                warnings.push(ReadWarning::TrailingUnchecked { at_least: trailing });
                break;
            }
        }
        if matches!(&self.source, Source::Gzip(z) if z.garbage) {
            warnings.push(ReadWarning::GarbageAfterGzip);
        }
        Ok(warnings)
    }
}

/// Names the file formats that users mistake for NIfTI.
fn looks_like(bytes: &[u8], compressed: bool) -> String {
    let known: [(usize, &[u8], &str); 12] = [
        (128, b"DICM", "a DICOM file"),
        (0, b"NRRD", "an NRRD file"),
        (0, b"ObjectType", "a MetaImage header"),
        (0, b"# vtk", "a VTK file"),
        (0, b"solid", "an STL surface"),
        (0, b"PK\x03\x04", "a zip archive"),
        (0, b"\x1f\x8b", "a gzip file"),
        (0, b"BZh", "a bzip2 file"),
        (0, b"\xfd7zXZ", "an xz file"),
        (0, b"\x28\xb5\x2f\xfd", "a Zstandard file"),
        (0, b"\x89HDF", "an HDF5 file"),
        (0, b"\x93NUMPY", "a NumPy array"),
    ];
    let inside = if compressed { " within gzip" } else { "" };
    let hit = known
        .iter()
        .find(|(at, magic, _)| bytes.get(*at..).is_some_and(|b| b.starts_with(magic)));
    match hit {
        Some((_, _, name)) => format!("it looks like {name}{inside}"),
        None if bytes.is_empty() => format!("it is empty{inside}"),
        None => {
            let first: Vec<String> = bytes.iter().take(4).map(|b| format!("{b:02x}")).collect();
            format!("it starts with bytes {}{inside}", first.join(" "))
        }
    }
}
