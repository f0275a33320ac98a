//! The zip layout: stored entries at multiples of 64 bytes, fixed times and permissions, nothing between the
//! records. One content has one byte sequence, and the reader accepts no other: it rebuilds every record from
//! names, sizes and checksums and compares, so a flip anywhere in the file is found.

use crate::PackageError;
use std::collections::BTreeSet;

/// Entry data starts at multiples of this, so that a mapped file gives aligned arrays.
pub(crate) const ALIGN: usize = 64;
/// Zip without its 64-bit extension: the last byte's offset must fit 32 bits.
pub(crate) const MAX_BYTES: u64 = u32::MAX as u64;
const MAX_ENTRIES: usize = u16::MAX as usize - 1;

const LOCAL: u32 = 0x0403_4b50;
const CENTRAL: u32 = 0x0201_4b50;
const END: u32 = 0x0605_4b50;
const LOCAL_LEN: usize = 30;
const CENTRAL_LEN: usize = 46;
const END_LEN: usize = 22;
/// Extra field that zip tools use for alignment padding.
const PADDING_ID: u16 = 0xd935;
/// 1980-01-01, the first day that zip knows.
const DATE: u16 = 0x0021;
/// Regular file, rw-r--r--.
const ATTRIBUTES: u32 = 0o100_644 << 16;

/// One named run of bytes; `data` is borrowed from the file.
#[derive(Clone, Debug)]
pub(crate) struct Entry<'a> {
    pub(crate) name: String,
    pub(crate) data: &'a [u8],
    pub(crate) crc: u32,
}

/// Size of the archive that [`write`] makes of these entries.
pub(crate) fn archive_len(entries: &[(String, Vec<u8>)]) -> u64 {
    let mut at = 0u64;
    for (name, data) in entries {
        at += (LOCAL_LEN + name.len() + padding(at as usize, name.len())) as u64 + data.len() as u64;
    }
    at + entries
        .iter()
        .map(|(n, _)| (CENTRAL_LEN + n.len()) as u64)
        .sum::<u64>()
        + END_LEN as u64
}

/// The archive as bytes.
pub(crate) fn write(entries: &[(String, Vec<u8>)]) -> Result<Vec<u8>, PackageError> {
    let total = archive_len(entries);
    if total > MAX_BYTES || entries.len() > MAX_ENTRIES {
        return Err(PackageError::TooLarge {
            what: "the model".into(),
            bytes: total,
            limit: MAX_BYTES,
        });
    }
    let mut out = Vec::with_capacity(total as usize);
    let mut central = Vec::new();
    for (name, data) in entries {
        let crc = crc32fast::hash(data);
        let offset = out.len();
        local_record(&mut out, name, crc, data.len());
        out.extend_from_slice(data);
        central_record(&mut central, name, crc, data.len(), offset);
    }
    let start = out.len();
    out.extend_from_slice(&central);
    end_record(&mut out, entries.len(), central.len(), start);
    Ok(out)
}

/// Extra-field bytes that bring the data of an entry whose record starts at `offset` to a multiple of [`ALIGN`].
fn padding(offset: usize, name: usize) -> usize {
    let least = offset + LOCAL_LEN + name + 6;
    least.next_multiple_of(ALIGN) - (offset + LOCAL_LEN + name)
}

fn u16s(out: &mut Vec<u8>, values: &[u16]) {
    for v in values {
        out.extend_from_slice(&v.to_le_bytes());
    }
}

fn u32s(out: &mut Vec<u8>, values: &[u32]) {
    for v in values {
        out.extend_from_slice(&v.to_le_bytes());
    }
}

fn local_record(out: &mut Vec<u8>, name: &str, crc: u32, size: usize) {
    let pad = padding(out.len(), name.len());
    u32s(out, &[LOCAL]);
    u16s(out, &[10, 0, 0, 0, DATE]);
    u32s(out, &[crc, size as u32, size as u32]);
    u16s(out, &[name.len() as u16, pad as u16]);
    out.extend_from_slice(name.as_bytes());
    u16s(out, &[PADDING_ID, pad as u16 - 4, ALIGN as u16]);
    out.resize(out.len() + pad - 6, 0);
}

fn central_record(out: &mut Vec<u8>, name: &str, crc: u32, size: usize, offset: usize) {
    u32s(out, &[CENTRAL]);
    // Made by: Unix, zip 2.0; needed: 1.0.
    u16s(out, &[3 << 8 | 20, 10, 0, 0, 0, DATE]);
    u32s(out, &[crc, size as u32, size as u32]);
    u16s(out, &[name.len() as u16, 0, 0, 0, 0]);
    u32s(out, &[ATTRIBUTES, offset as u32]);
    out.extend_from_slice(name.as_bytes());
}

fn end_record(out: &mut Vec<u8>, entries: usize, central: usize, start: usize) {
    u32s(out, &[END]);
    u16s(out, &[0, 0, entries as u16, entries as u16]);
    u32s(out, &[central as u32, start as u32]);
    u16s(out, &[0]);
}

fn get16(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_le_bytes(
        bytes.get(at..at.checked_add(2)?)?.try_into().ok()?,
    ))
}

fn get32(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(
        bytes.get(at..at.checked_add(4)?)?.try_into().ok()?,
    ))
}

fn container(offset: usize, what: impl Into<String>) -> PackageError {
    PackageError::Container {
        offset: offset as u64,
        what: what.into(),
    }
}

/// The entries of an archive, in file order. With `strict` the whole layout and every CRC-32 is checked; without,
/// only what is needed to find the data (for fuzzing the checks behind).
pub(crate) fn read(bytes: &[u8], strict: bool) -> Result<Vec<Entry<'_>>, PackageError> {
    if get32(bytes, 0) != Some(LOCAL) {
        let head = &bytes[..bytes.len().min(4)];
        let found = match head {
            [] => "the file is empty".into(),
            [0x1f, 0x8b, ..] => "it starts like a gzip file".into(),
            _ => format!("it starts with the bytes {head:02x?}"),
        };
        return Err(PackageError::NotAPackage { found });
    }
    let end = match bytes.len().checked_sub(END_LEN) {
        Some(at) if get32(bytes, at) == Some(END) => at,
        _ => {
            return Err(PackageError::Truncated {
                what: format!(
                    "the last {END_LEN} bytes of {} are not a zip end record",
                    bytes.len()
                ),
            });
        }
    };
    let field = |at: usize| get16(bytes, end + at).unwrap_or(0);
    let (count, size, start) = (
        usize::from(field(10)),
        get32(bytes, end + 12).unwrap_or(0) as usize,
        get32(bytes, end + 16).unwrap_or(0) as usize,
    );
    if start.checked_add(size) != Some(end) {
        return Err(container(
            end,
            format!("directory of {size} bytes at {start} does not end at {end}"),
        ));
    }
    // Each record takes at least this much, so a false count cannot make the reader reserve memory.
    if count > size / CENTRAL_LEN {
        return Err(container(
            end,
            format!("{count} entries claimed in a directory of {size} bytes"),
        ));
    }
    let central = &bytes[start..end];
    let mut entries = Vec::with_capacity(count);
    let mut names = BTreeSet::new();
    let mut at = 0;
    for _ in 0..count {
        let entry = central_entry(bytes, central, start, &mut at, strict)?;
        if !names.insert(entry.name.clone()) {
            return Err(PackageError::Duplicate { entry: entry.name });
        }
        entries.push(entry);
    }
    if at != central.len() {
        return Err(container(start + at, "bytes behind the last directory record"));
    }
    if strict {
        check_layout(bytes, &entries, start)?;
        for e in &entries {
            let computed = crc32fast::hash(e.data);
            if computed != e.crc {
                return Err(PackageError::Checksum {
                    entry: e.name.clone(),
                    kind: "CRC-32",
                    recorded: format!("{:08x}", e.crc),
                    computed: format!("{computed:08x}"),
                });
            }
        }
    }
    Ok(entries)
}

fn central_entry<'a>(
    bytes: &'a [u8],
    central: &[u8],
    start: usize,
    at: &mut usize,
    strict: bool,
) -> Result<Entry<'a>, PackageError> {
    let here = start + *at;
    let short = || container(here, "directory record is cut short");
    let u16_at = |o: usize| get16(central, *at + o).ok_or_else(short);
    let u32_at = |o: usize| get32(central, *at + o).ok_or_else(short);
    if u32_at(0)? != CENTRAL {
        return Err(container(here, "not a directory record"));
    }
    let (flags, method, crc) = (u16_at(8)?, u16_at(10)?, u32_at(16)?);
    let (packed, size, offset) = (u32_at(20)? as usize, u32_at(24)? as usize, u32_at(42)? as usize);
    let (name_len, extra, comment) = (u16_at(28)? as usize, u16_at(30)? as usize, u16_at(32)? as usize);
    let name = central
        .get(*at + CENTRAL_LEN..*at + CENTRAL_LEN + name_len)
        .ok_or_else(short)?;
    let name = match std::str::from_utf8(name) {
        Ok(n) if !n.is_empty() && n.bytes().all(|b| b.is_ascii_graphic()) => n.to_string(),
        _ => return Err(container(here, "entry name is not printable ASCII")),
    };
    *at += CENTRAL_LEN + name_len + extra + comment;
    if method != 0 {
        return Err(PackageError::Compressed { entry: name, method });
    }
    if flags != 0 {
        return Err(container(
            here,
            format!("{name}: flags {flags:#06x}, expected none"),
        ));
    }
    if packed != size {
        return Err(container(
            here,
            format!("{name}: stored size {packed} differs from its size {size}"),
        ));
    }
    let gap = |o: usize| get16(bytes, offset + o).map(usize::from);
    let data = match (gap(26), gap(28)) {
        (Some(n), Some(x)) if !strict || n == name_len => offset + LOCAL_LEN + n + x,
        _ => return Err(container(offset, format!("{name}: no entry record there"))),
    };
    let data = data
        .checked_add(size)
        .filter(|&e| e <= start)
        .map(|e| &bytes[data..e]);
    let data = data.ok_or_else(|| {
        container(
            here,
            format!("{name}: {size} bytes at {offset} overlap the directory"),
        )
    })?;
    Ok(Entry { name, data, crc })
}

/// Every record must be byte for byte what [`write`] makes of the entries' names, sizes and checksums.
fn check_layout(bytes: &[u8], entries: &[Entry<'_>], start: usize) -> Result<(), PackageError> {
    let mut at = 0;
    let mut record = Vec::new();
    let mut central = Vec::new();
    for e in entries {
        central_record(&mut central, &e.name, e.crc, e.data.len(), at);
        record.clear();
        let pad = padding(at, e.name.len());
        local_record_at(&mut record, at, &e.name, e.crc, e.data.len());
        let head = LOCAL_LEN + e.name.len() + pad;
        match bytes.get(at..at + head) {
            Some(found) if found == record.as_slice() => at += head + e.data.len(),
            _ => {
                return Err(container(
                    at,
                    format!("{}: entry record differs from its directory record", e.name),
                ));
            }
        }
    }
    if at != start {
        return Err(container(at, "bytes between the last entry and the directory"));
    }
    let size = central.len();
    end_record(&mut central, entries.len(), size, start);
    match central.iter().zip(&bytes[start..]).position(|(a, b)| a != b) {
        None if central.len() == bytes.len() - start => Ok(()),
        None => Err(container(
            start + central.len(),
            "directory has another length than its entries ask for",
        )),
        Some(i) => Err(container(
            start + i,
            "directory differs from what its entries ask for",
        )),
    }
}

fn local_record_at(out: &mut Vec<u8>, offset: usize, name: &str, crc: u32, size: usize) {
    // The record's padding depends on where it starts; only that remainder matters.
    let lead = offset % ALIGN;
    out.resize(lead, 0);
    local_record(out, name, crc, size);
    out.drain(..lead);
}
