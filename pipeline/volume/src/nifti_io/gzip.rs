use crate::ReadFault;
use flate2::{Decompress, FlushDecompress, Status};
use std::io::BufRead;

const FHCRC: u8 = 2;
const FEXTRA: u8 = 4;
const FNAME: u8 = 8;
const FCOMMENT: u8 = 16;
const RESERVED: u8 = 0xe0;

/// Deflate packs 258 bytes into no less than 2 bits.
pub(super) const MOST_EXPANSION: u64 = 1032;

/// Unpacks gzip files of one or several members and checks every checksum.
///
/// Framing and CRC are here rather than flate2's because its CRC costs four times what inflating a label map does.
pub(super) struct GzipReader<R> {
    inner: R,
    inflate: Decompress,
    crc: crc32fast::Hasher,
    member_bytes: u64,
    total_bytes: u64,
    in_member: bool,
    /// Bytes follow the last member that are no gzip member.
    pub(super) garbage: bool,
}

impl<R: BufRead> GzipReader<R> {
    /// Reads the first member's header.
    pub(super) fn new(inner: R) -> Result<Self, ReadFault> {
        let mut out = Self {
            inner,
            inflate: Decompress::new(false),
            crc: crc32fast::Hasher::new(),
            member_bytes: 0,
            total_bytes: 0,
            in_member: false,
            garbage: false,
        };
        if !out.start_member()? {
            return Err(out.corrupt("no gzip header"));
        }
        Ok(out)
    }

    /// Unpacks into `out`; 0 only where `out` is empty or the last member has ended and its checksum was right.
    pub(super) fn read(&mut self, out: &mut [u8]) -> Result<usize, ReadFault> {
        while !out.is_empty() && self.in_member {
            let packed = self.inner.fill_buf().map_err(ReadFault::Io)?;
            let at_end = packed.is_empty();
            let (in0, out0) = (self.inflate.total_in(), self.inflate.total_out());
            let status = self.inflate.decompress(packed, out, FlushDecompress::None);
            let used = (self.inflate.total_in() - in0) as usize;
            let made = (self.inflate.total_out() - out0) as usize;
            self.inner.consume(used);
            let status = status.map_err(|_| self.corrupt("invalid deflate data"))?;
            self.crc.update(&out[..made]);
            self.member_bytes += made as u64;
            self.total_bytes += made as u64;
            if status == Status::StreamEnd {
                self.end_member()?;
            } else if made == 0 && at_end {
                return Err(self.truncated());
            } else if made == 0 && used == 0 {
                return Err(self.corrupt("the stream does not go on"));
            }
            if made > 0 {
                return Ok(made);
            }
        }
        Ok(0)
    }

    fn truncated(&self) -> ReadFault {
        ReadFault::TruncatedGzip {
            have: self.total_bytes,
        }
    }

    fn corrupt(&self, what: &'static str) -> ReadFault {
        ReadFault::CorruptGzip {
            have: self.total_bytes,
            what,
        }
    }

    fn byte(&mut self) -> Result<u8, ReadFault> {
        let byte = self.inner.fill_buf().map_err(ReadFault::Io)?.first().copied();
        self.inner.consume(usize::from(byte.is_some()));
        byte.ok_or_else(|| self.truncated())
    }

    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], ReadFault> {
        let mut out = [0; N];
        for b in &mut out {
            *b = self.byte()?;
        }
        Ok(out)
    }

    /// Goes to a member's first deflate byte; false where something else follows, or nothing.
    fn start_member(&mut self) -> Result<bool, ReadFault> {
        for id in [0x1f, 0x8b] {
            let ahead = self.inner.fill_buf().map_err(ReadFault::Io)?;
            if ahead.first() != Some(&id) {
                // What gzip itself ignores too, with a warning.
                self.garbage = !ahead.is_empty() || id == 0x8b;
                return Ok(false);
            }
            self.inner.consume(1);
        }
        let [method, flags] = self.bytes()?;
        if method != 8 || flags & RESERVED != 0 {
            return Err(self.corrupt("unknown compression method or flags"));
        }
        let _time_and_system: [u8; 6] = self.bytes()?;
        if flags & FEXTRA != 0 {
            let len = u16::from_le_bytes(self.bytes()?);
            for _ in 0..len {
                self.byte()?;
            }
        }
        for flag in [FNAME, FCOMMENT] {
            if flags & flag != 0 {
                while self.byte()? != 0 {}
            }
        }
        if flags & FHCRC != 0 {
            let _header_crc: [u8; 2] = self.bytes()?;
        }
        self.inflate.reset(false);
        self.crc.reset();
        self.member_bytes = 0;
        self.in_member = true;
        Ok(true)
    }

    fn end_member(&mut self) -> Result<(), ReadFault> {
        self.in_member = false;
        let stored = u32::from_le_bytes(self.bytes()?);
        let length = u32::from_le_bytes(self.bytes()?);
        let computed = self.crc.clone().finalize();
        if stored != computed {
            return Err(ReadFault::Checksum { stored, computed });
        }
        if length != self.member_bytes as u32 {
            return Err(self.corrupt("the stored length is wrong"));
        }
        self.start_member()?;
        Ok(())
    }
}
