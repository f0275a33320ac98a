/// Element types that a package holds, all little-endian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Dtype {
    F32,
    F64,
    U8,
    U16,
    U32,
    I16,
    I32,
}

impl Dtype {
    const ALL: [Self; 7] = [
        Self::F32,
        Self::F64,
        Self::U8,
        Self::U16,
        Self::U32,
        Self::I16,
        Self::I32,
    ];

    /// The `descr` of the `.npy` header.
    pub(crate) fn descr(self) -> &'static str {
        match self {
            Self::F32 => "<f4",
            Self::F64 => "<f8",
            Self::U8 => "|u1",
            Self::U16 => "<u2",
            Self::U32 => "<u4",
            Self::I16 => "<i2",
            Self::I32 => "<i4",
        }
    }

    pub(crate) fn size(self) -> usize {
        match self {
            Self::U8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::F32 | Self::U32 | Self::I32 => 4,
            Self::F64 => 8,
        }
    }

    fn from_descr(descr: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|d| d.descr() == descr)
    }
}

/// A Rust type with its place in a file.
pub(crate) trait Element: Copy {
    const DTYPE: Dtype;
    fn put(self, place: &mut [u8]);
    fn get(bytes: &[u8]) -> Self;
}

macro_rules! element {
    ($($t:ty, $d:ident;)*) => {$(
        impl Element for $t {
            const DTYPE: Dtype = Dtype::$d;
            fn put(self, place: &mut [u8]) {
                place.copy_from_slice(&self.to_le_bytes());
            }
            fn get(bytes: &[u8]) -> Self {
                let mut b = [0u8; size_of::<$t>()];
                b.copy_from_slice(bytes);
                Self::from_le_bytes(b)
            }
        }
    )*};
}
element! { f32, F32; f64, F64; u8, U8; u16, U16; u32, U32; i16, I16; }

const MAGIC: &[u8; 6] = b"\x93NUMPY";
/// Most dimensions that a header may claim; packages use up to three.
const MAX_DIMS: usize = 4;

/// A parsed array: its data is still in the file's bytes.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ArrayView<'a> {
    pub(crate) dtype: Dtype,
    pub(crate) shape: Vec<usize>,
    pub(crate) data: &'a [u8],
}

/// Text of a shape as Python prints it.
pub(crate) fn shape_text(shape: &[usize]) -> String {
    match shape {
        [n] => format!("({n},)"),
        _ => format!(
            "({})",
            shape
                .iter()
                .map(ToString::to_string)
                .collect::<Vec<_>>()
                .join(", ")
        ),
    }
}

/// A version 1.0 `.npy` file whose data starts at a multiple of 64 bytes.
pub(crate) fn encode<T: Element>(shape: &[usize], data: impl IntoIterator<Item = T>) -> Vec<u8> {
    let dict = format!(
        "{{'descr': '{}', 'fortran_order': False, 'shape': {}, }}",
        T::DTYPE.descr(),
        shape_text(shape)
    );
    // Magic 6, version 2, header length 2, then the dictionary, spaces and a newline up to a multiple of 64.
    let header = (10 + dict.len() + 1).next_multiple_of(64);
    let count = shape.iter().product::<usize>();
    let mut out = Vec::with_capacity(header + count * T::DTYPE.size());
    out.extend_from_slice(MAGIC);
    out.extend_from_slice(&[1, 0]);
    out.extend_from_slice(&((header - 10) as u16).to_le_bytes());
    out.extend_from_slice(dict.as_bytes());
    out.resize(header - 1, b' ');
    out.push(b'\n');
    out.resize(header + count * T::DTYPE.size(), 0);
    for (place, v) in out[header..].chunks_exact_mut(T::DTYPE.size()).zip(data) {
        v.put(place);
    }
    out
}

/// Reads a version 1.0 or 2.0 header and checks that the data has exactly the length that the shape asks for.
pub(crate) fn parse(bytes: &[u8]) -> Result<ArrayView<'_>, String> {
    let magic = bytes.get(..6).ok_or("shorter than a .npy header")?;
    if magic != MAGIC {
        return Err("does not start with the .npy magic".into());
    }
    let version = bytes.get(6..8).ok_or("shorter than a .npy header")?;
    let (start, length) = match version {
        [1, 0] => {
            let b = bytes.get(8..10).ok_or("shorter than a .npy header")?;
            (10, usize::from(u16::get(b)))
        }
        [2, 0] => {
            let b = bytes.get(8..12).ok_or("shorter than a .npy header")?;
            (12, u32::get(b) as usize)
        }
        other => {
            return Err(format!(
                ".npy version {}.{}, expected 1.0 or 2.0",
                other[0], other[1]
            ));
        }
    };
    let end = length.checked_add(start).filter(|&e| e <= bytes.len());
    let end =
        end.ok_or_else(|| format!(".npy header claims {length} bytes, the entry has {}", bytes.len()))?;
    let header = std::str::from_utf8(&bytes[start..end]).map_err(|_| ".npy header is not text")?;
    let (dtype, shape) = dictionary(header)?;
    let data = &bytes[end..];
    let expected = shape
        .iter()
        .try_fold(dtype.size(), |n, &d| n.checked_mul(d))
        .ok_or("shape overflows".to_string())?;
    if expected != data.len() {
        return Err(format!(
            "shape {} of {} needs {expected} bytes of data, the entry has {}",
            shape_text(&shape),
            dtype.descr(),
            data.len()
        ));
    }
    Ok(ArrayView { dtype, shape, data })
}

/// `{'descr': '<f4', 'fortran_order': False, 'shape': (3, 4), }` with its keys in any order.
fn dictionary(header: &str) -> Result<(Dtype, Vec<usize>), String> {
    let bad = || {
        format!(
            "unreadable .npy header {:?}",
            header.trim_end().chars().take(120).collect::<String>()
        )
    };
    let mut rest = header.trim().strip_prefix('{').ok_or_else(bad)?;
    let (mut dtype, mut order, mut shape) = (None, None, None);
    loop {
        rest = rest.trim_start();
        if let Some(after) = rest.strip_prefix('}') {
            if !after.trim().is_empty() {
                return Err(bad());
            }
            break;
        }
        let (key, after) = rest
            .strip_prefix('\'')
            .and_then(|r| r.split_once('\''))
            .ok_or_else(bad)?;
        rest = after.trim_start().strip_prefix(':').ok_or_else(bad)?.trim_start();
        match key {
            "descr" if dtype.is_none() => {
                let (value, after) = rest
                    .strip_prefix('\'')
                    .and_then(|r| r.split_once('\''))
                    .ok_or_else(bad)?;
                dtype = Some(Dtype::from_descr(value).ok_or_else(|| {
                    format!("element type {value:?}, expected one of <f4 <f8 |u1 <u2 <u4 <i2 <i4")
                })?);
                rest = after;
            }
            "fortran_order" if order.is_none() => {
                rest = rest.strip_prefix("False").ok_or("array is not in C order")?;
                order = Some(());
            }
            "shape" if shape.is_none() => {
                let (value, after) = rest
                    .strip_prefix('(')
                    .and_then(|r| r.split_once(')'))
                    .ok_or_else(bad)?;
                shape = Some(tuple(value).ok_or_else(bad)?);
                rest = after;
            }
            _ => return Err(bad()),
        }
        rest = rest.trim_start();
        rest = match rest.strip_prefix(',') {
            Some(after) => after,
            None if rest.starts_with('}') => rest,
            None => return Err(bad()),
        };
    }
    match (dtype, order, shape) {
        (Some(dtype), Some(()), Some(shape)) => Ok((dtype, shape)),
        _ => Err(bad()),
    }
}

fn tuple(text: &str) -> Option<Vec<usize>> {
    let text = text.trim();
    if text.is_empty() {
        return Some(Vec::new());
    }
    let text = text.strip_suffix(',').unwrap_or(text);
    let mut out = Vec::new();
    for part in text.split(',') {
        if out.len() == MAX_DIMS || !part.trim().bytes().all(|b| b.is_ascii_digit()) {
            return None;
        }
        out.push(part.trim().parse().ok()?);
    }
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn header_is_the_one_numpy_writes() {
        let bytes = encode::<f32>(&[2, 3], [1.0f32, 2.0, 3.0, 4.0, 5.0, 6.0]);
        assert_eq!(&bytes[..8], b"\x93NUMPY\x01\x00");
        assert_eq!(bytes.len(), 128 + 24);
        assert!(bytes[10..].starts_with(b"{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), }  "));
        assert_eq!(bytes[127], b'\n');
        let view = parse(&bytes).unwrap();
        assert_eq!(
            (view.dtype, view.shape.as_slice()),
            (Dtype::F32, &[2usize, 3][..])
        );
        assert_eq!(f32::get(&view.data[20..24]), 6.0);
        assert!(
            encode::<u8>(&[4], [0u8; 4])[10..]
                .starts_with(b"{'descr': '|u1', 'fortran_order': False, 'shape': (4,), }")
        );
    }

    #[test]
    fn version_two_and_other_key_orders_are_read() {
        let dict = b"{\"shape\"";
        assert!(dictionary(std::str::from_utf8(dict).unwrap()).is_err());
        let dict = b" { 'shape':(2 , ) ,'fortran_order' : False,'descr':'<i2'}\n";
        let mut bytes = b"\x93NUMPY\x02\x00".to_vec();
        bytes.extend_from_slice(&(dict.len() as u32).to_le_bytes());
        bytes.extend_from_slice(dict);
        bytes.extend_from_slice(&[1, 0, 2, 0]);
        let view = parse(&bytes).unwrap();
        assert_eq!((view.dtype, view.shape), (Dtype::I16, vec![2]));
    }

    #[test]
    fn claims_beyond_the_data_are_refused() {
        let good = encode::<u32>(&[5], [0u32; 5]);
        assert!(
            parse(&good[..good.len() - 1])
                .unwrap_err()
                .contains("needs 20 bytes")
        );
        for shape in [
            "(18446744073709551615, 16)",
            "(99999999999999999999,)",
            "(-1,)",
            "(1, 1, 1, 1, 5)",
            "(5",
        ] {
            let dict = format!("{{'descr': '<u4', 'fortran_order': False, 'shape': {shape}, }}");
            let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
            bytes.extend_from_slice(&(dict.len() as u16).to_le_bytes());
            bytes.extend_from_slice(dict.as_bytes());
            bytes.extend_from_slice(&[0; 20]);
            assert!(parse(&bytes).is_err(), "{shape}");
        }
        let mut fortran = good.clone();
        let at = fortran.windows(5).position(|w| w == b"False").unwrap();
        fortran[at..at + 5].copy_from_slice(b"True ");
        assert_eq!(parse(&fortran).unwrap_err(), "array is not in C order");
    }
}
