//! Damaged files: every flipped bit is noticed, every cut is noticed, nothing panics, and the error says where.

mod common;

use common::{bare_model, small_model};
use palpate_package::*;

fn small_bytes() -> Vec<u8> {
    small_model().to_bytes().unwrap().0
}

/// A flip in each byte of the bare package: records, padding, manifest, headers and data alike.
#[test]
fn a_flipped_bit_anywhere_is_noticed() {
    let good = bare_model().to_bytes().unwrap().0;
    let mut bytes = good.clone();
    for at in 0..bytes.len() {
        bytes[at] ^= 1 << (at % 8);
        let read = ModelPackage::read_bytes(&bytes);
        assert!(
            read.is_err(),
            "bit {} of byte {at} of {} went unnoticed",
            at % 8,
            bytes.len()
        );
        bytes[at] = good[at];
    }
    assert!(ModelPackage::read_bytes(&bytes).is_ok());
}

/// All eight bits in one byte of the name, the padding, the array header and the data of each entry.
#[test]
fn flips_in_each_entry_are_noticed() {
    let good = small_bytes();
    let mut zip = zip::ZipArchive::new(std::io::Cursor::new(good.as_slice())).unwrap();
    let mut places = vec![];
    for i in 0..zip.len() {
        let e = zip.by_index(i).unwrap();
        let (head, data) = (e.header_start() as usize, e.data_start().unwrap() as usize);
        let size = e.size() as usize;
        places.extend([head, head + 30, data - 1, data, data + size / 2, data + size - 1]);
        places.push(e.central_header_start() as usize + 10);
    }
    assert!(places.len() > 250);
    let mut bytes = good.clone();
    for at in places {
        for bit in 0..8 {
            bytes[at] ^= 1 << bit;
            assert!(
                ModelPackage::read_bytes(&bytes).is_err(),
                "bit {bit} of byte {at}"
            );
            bytes[at] = good[at];
        }
    }
}

#[test]
fn a_cut_anywhere_is_noticed() {
    let good = small_bytes();
    for cut in (0..good.len())
        .step_by(64)
        .chain([1, 3, 21, 22, 23, good.len() - 1])
    {
        let problem = ModelPackage::read_bytes(&good[..cut]).unwrap_err();
        assert!(
            matches!(
                problem,
                PackageError::Truncated { .. } | PackageError::NotAPackage { .. }
            ),
            "cut at {cut}: {problem}"
        );
    }
    let mut longer = good.clone();
    longer.push(0);
    assert!(matches!(
        ModelPackage::read_bytes(&longer),
        Err(PackageError::Truncated { .. })
    ));
    let doubled = [good.as_slice(), good.as_slice()].concat();
    assert!(matches!(
        ModelPackage::read_bytes(&doubled),
        Err(PackageError::Container { .. })
    ));
}

#[test]
fn other_files_are_told_apart() {
    let text = |bytes: &[u8]| ModelPackage::read_bytes(bytes).unwrap_err().to_string();
    assert!(text(b"").contains("the file is empty"));
    assert!(text(&[0x1f, 0x8b, 8, 0, 0]).contains("gzip"));
    assert!(text(b"ply\nformat").contains("not a model package"));
}

/// Rewrites a package with another zip library, so that its records are valid and only the content is in question.
fn rezip(
    bytes: &[u8],
    method: zip::CompressionMethod,
    change: impl Fn(&str, Vec<u8>) -> Option<Vec<u8>>,
) -> Vec<u8> {
    use std::io::{Read, Write};
    let mut from = zip::ZipArchive::new(std::io::Cursor::new(bytes)).unwrap();
    let mut to = zip::ZipWriter::new(std::io::Cursor::new(vec![]));
    let options = zip::write::SimpleFileOptions::default().compression_method(method);
    for i in 0..from.len() {
        let mut e = from.by_index(i).unwrap();
        let name = e.name().unwrap().to_string();
        let mut data = vec![];
        e.read_to_end(&mut data).unwrap();
        if let Some(data) = change(&name, data) {
            to.start_file(&*name, options).unwrap();
            to.write_all(&data).unwrap();
        }
    }
    to.finish().unwrap().into_inner()
}

#[test]
fn a_package_rewritten_by_another_tool_says_so() {
    let again = rezip(&small_bytes(), zip::CompressionMethod::Stored, |_, d| Some(d));
    let problem = ModelPackage::read_bytes(&again).unwrap_err();
    assert!(
        problem.to_string().contains("rewritten by another tool"),
        "{problem}"
    );
    // Its content is whole: without the layout check it is the same model.
    let options = ReadOptions { checksums: false };
    assert_eq!(
        ModelPackage::read_bytes_with(&again, options).unwrap(),
        small_model()
    );
}

/// Without checksums, as an attacker would make them right: entries added, lost, of another type or shape.
#[test]
fn wrong_sets_of_entries_are_named() {
    let options = ReadOptions { checksums: false };
    let read = |change: &dyn Fn(&str, Vec<u8>) -> Option<Vec<u8>>| {
        let bytes = rezip(&small_bytes(), zip::CompressionMethod::Stored, change);
        ModelPackage::read_bytes_with(&bytes, options).unwrap_err()
    };
    let lost = read(&|n, d| (n != "clusters/members.npy").then_some(d));
    assert!(
        matches!(&lost, PackageError::Missing { entry } if entry == "clusters/members.npy"),
        "{lost}"
    );
    let lost = read(&|n, d| (n != "manifest.json").then_some(d));
    assert!(
        matches!(&lost, PackageError::Missing { entry } if entry == "manifest.json"),
        "{lost}"
    );

    let swap = |d: Vec<u8>, a: &str, b: &str| {
        let text: Vec<u8> = d;
        let at = text.windows(a.len()).position(|w| w == a.as_bytes()).unwrap();
        let mut out = text[..at].to_vec();
        out.extend_from_slice(b.as_bytes());
        out.extend_from_slice(&text[at + a.len()..]);
        out
    };
    let of = |name: &'static str, a: &'static str, b: &'static str| {
        read(&move |n, d| Some(if n == name { swap(d, a, b) } else { d }))
    };
    let wrong = of("fem/tets.npy", "<u4", "<i4");
    assert!(
        matches!(&wrong, PackageError::Dtype { entry, .. } if entry == "fem/tets.npy"),
        "{wrong}"
    );
    let wrong = of("fem/tets.npy", "(360, 4)", "(720, 2)");
    assert!(
        matches!(&wrong, PackageError::Shape { entry, .. } if entry == "fem/tets.npy"),
        "{wrong}"
    );
    let wrong = of("labels/data.npy", "(8, 10, 12)", "(8, 10, 13)");
    assert!(
        matches!(&wrong, PackageError::Malformed { entry, .. } if entry == "labels/data.npy"),
        "{wrong}"
    );
    let wrong = of("manifest.json", "clusters/region.npy", "clusters/legion.npy");
    assert!(
        matches!(&wrong, PackageError::Unexpected { entry } if entry == "clusters/region.npy"),
        "{wrong}"
    );
    let wrong = of("manifest.json", "\"units\": {", "\"unitz\": {");
    assert!(
        matches!(&wrong, PackageError::Malformed { entry, .. } if entry == "manifest.json"),
        "{wrong}"
    );
    let wrong = of(
        "manifest.json",
        "\"format\": \"palpate-model\"",
        "\"format\": \"another\"",
    );
    assert!(wrong.to_string().contains("format \"another\""), "{wrong}");
}

#[test]
fn a_newer_schema_has_its_own_error() {
    let bytes = rezip(&small_bytes(), zip::CompressionMethod::Stored, |name, data| {
        if name != "manifest.json" {
            return Some(data);
        }
        let text = String::from_utf8(data).unwrap();
        Some(
            text.replace("\"schema\": 1,", "\"schema\": 7, \"something_new\": [1],")
                .into_bytes(),
        )
    });
    let options = ReadOptions { checksums: false };
    let problem = ModelPackage::read_bytes_with(&bytes, options).unwrap_err();
    assert!(matches!(
        problem,
        PackageError::NewerSchema {
            found: 7,
            supported: SCHEMA
        }
    ));
    assert!(problem.to_string().contains("update Palpate"), "{problem}");
}

#[test]
fn compressed_entries_and_twin_names_are_refused_before_their_content_is_looked_at() {
    // The method field of the third directory record, made `deflated`.
    let good = small_bytes();
    let (third, second) = {
        let mut zip = zip::ZipArchive::new(std::io::Cursor::new(good.as_slice())).unwrap();
        let a = zip.by_index(2).unwrap().central_header_start() as usize;
        (a, zip.by_index(1).unwrap().central_header_start() as usize)
    };
    let mut bytes = good.clone();
    bytes[third + 10] = 8;
    let problem = ModelPackage::read_bytes(&bytes).unwrap_err();
    assert!(
        matches!(problem, PackageError::Compressed { method: 8, .. }),
        "{problem}"
    );
    // The same record twice, where both names are equally long: fem/tets and fem… differ, so copy a whole record.
    let mut bytes = good.clone();
    let len = third - second;
    let name = String::from_utf8(bytes[second + 46..third].to_vec()).unwrap();
    let at = bytes.windows(4).rposition(|w| w == b"PK\x05\x06").unwrap();
    let record = bytes[second..third].to_vec();
    bytes.splice(at..at, record);
    let end = at + len;
    let count = u16::from_le_bytes([bytes[end + 10], bytes[end + 11]]) + 1;
    bytes[end + 8..end + 10].copy_from_slice(&count.to_le_bytes());
    bytes[end + 10..end + 12].copy_from_slice(&count.to_le_bytes());
    let size = u32::from_le_bytes(bytes[end + 12..end + 16].try_into().unwrap()) + len as u32;
    bytes[end + 12..end + 16].copy_from_slice(&size.to_le_bytes());
    let problem = ModelPackage::read_bytes(&bytes).unwrap_err();
    assert!(
        matches!(&problem, PackageError::Duplicate { entry } if *entry == name),
        "{problem}"
    );
}

/// Claims of huge sizes are compared with what is there before anything is reserved.
#[test]
fn false_sizes_are_refused() {
    let good = small_bytes();
    let end = good.len() - 22;
    for (at, value) in [
        (end + 10, 0xffffu32),
        (end + 12, u32::MAX),
        (end + 16, u32::MAX),
        (end + 16, 0),
    ] {
        let mut bytes = good.clone();
        let width = if at == end + 10 { 2 } else { 4 };
        bytes[at..at + width].copy_from_slice(&value.to_le_bytes()[..width]);
        assert!(ModelPackage::read_bytes(&bytes).is_err());
    }
}
