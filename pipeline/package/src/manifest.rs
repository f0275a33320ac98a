use crate::model::{InputDigest, LabelEntry, ScanInfo, SurfaceKind};
use crate::{PackageError, SCHEMA};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use sha2::{Digest, Sha256};

/// Name of the manifest's entry, always the first.
pub(crate) const NAME: &str = "manifest.json";
const FORMAT: &str = "palpate-model";
const FRAME: &str = "patient RAS+ mm minus local_origin_mm";
/// More than any recipe and report take; JSON in memory is many times its text.
const MAX_BYTES: usize = 4 << 20;
const DIGEST_KEY: &str = "\"content_sha256\"";

/// `manifest.json` of schema 1. `content_sha256` is written behind it, see [`to_text`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Manifest {
    pub(crate) format: String,
    pub(crate) schema: u32,
    pub(crate) generator: String,
    pub(crate) units: Units,
    pub(crate) frame: String,
    pub(crate) local_origin_mm: [f64; 3],
    pub(crate) scan: ScanInfo,
    pub(crate) regions: Vec<String>,
    pub(crate) label_names: Vec<String>,
    pub(crate) label_table: Vec<LabelEntry>,
    pub(crate) inputs: Vec<InputDigest>,
    pub(crate) surfaces: Vec<SurfaceInfo>,
    pub(crate) particles: ParticleInfo,
    pub(crate) tagged: Vec<TaggedInfo>,
    pub(crate) fiducials: Vec<String>,
    pub(crate) recipe: Value,
    pub(crate) report: Value,
    pub(crate) entries: Vec<EntryInfo>,
    #[serde(default, skip_serializing)]
    pub(crate) content_sha256: String,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Units {
    length: String,
    mass: String,
    time: String,
    intensity: String,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SurfaceInfo {
    pub(crate) name: String,
    pub(crate) kind: SurfaceKind,
    /// Where its arrays are: `surfaces/kidney`.
    pub(crate) folder: String,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ParticleInfo {
    pub(crate) radius_mm: f64,
    pub(crate) mass_g: f64,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct TaggedInfo {
    pub(crate) name: String,
    pub(crate) region: u16,
    pub(crate) thickness_mm: f64,
    /// Where its array is: `fem/tagged/capsule`.
    pub(crate) folder: String,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct EntryInfo {
    pub(crate) name: String,
    pub(crate) dtype: String,
    pub(crate) shape: Vec<usize>,
    pub(crate) sha256: String,
}

pub(crate) fn hex(digest: &[u8]) -> String {
    digest.iter().map(|b| format!("{b:02x}")).collect()
}

pub(crate) fn sha256(bytes: &[u8]) -> String {
    hex(Sha256::digest(bytes).as_slice())
}

impl Manifest {
    pub(crate) fn fixed() -> (String, u32, Units, String) {
        let units = Units {
            length: "mm".into(),
            mass: "g".into(),
            time: "s".into(),
            intensity: "HU".into(),
        };
        (FORMAT.into(), SCHEMA, units, FRAME.into())
    }
}

/// The manifest's text and the content digest: SHA-256 of the text before the digest's own key. That text lists the
/// digest of every other entry, so one value stands for the whole package.
pub(crate) fn to_text(manifest: &Manifest) -> Result<(Vec<u8>, String), PackageError> {
    let mut text = serde_json::to_string_pretty(manifest)
        .map_err(|e| PackageError::malformed(NAME, format!("cannot be written: {e}")))?;
    // `skip_serializing` left the digest out; it goes in last, so that its own text is not part of it.
    let body = text
        .trim_end()
        .strip_suffix('}')
        .map(str::trim_end)
        .unwrap_or_default()
        .len();
    text.truncate(body);
    text.push_str(",\n  ");
    let digest = sha256(text.as_bytes());
    text.push_str(&format!("{DIGEST_KEY}: \"{digest}\"\n}}\n"));
    if text.len() > MAX_BYTES {
        return Err(PackageError::TooLarge {
            what: "manifest.json (recipe, report and names)".into(),
            bytes: text.len() as u64,
            limit: MAX_BYTES as u64,
        });
    }
    Ok((text.into_bytes(), digest))
}

/// Reads the manifest; the schema number is looked at before anything else of it.
pub(crate) fn from_text(bytes: &[u8], strict: bool) -> Result<Manifest, PackageError> {
    if bytes.len() > MAX_BYTES {
        return Err(PackageError::malformed(
            NAME,
            format!("{} bytes, at most {MAX_BYTES}", bytes.len()),
        ));
    }
    let text =
        std::str::from_utf8(bytes).map_err(|e| PackageError::malformed(NAME, format!("not UTF-8: {e}")))?;
    #[derive(Deserialize)]
    struct Head {
        format: String,
        schema: u64,
    }
    let head: Head = serde_json::from_str(text)
        .map_err(|e| PackageError::malformed(NAME, format!("not a package manifest: {e}")))?;
    if head.format != FORMAT {
        return Err(PackageError::malformed(
            NAME,
            format!("format {:?}, expected {FORMAT:?}", head.format),
        ));
    }
    if head.schema > u64::from(SCHEMA) {
        return Err(PackageError::NewerSchema {
            found: head.schema,
            supported: SCHEMA,
        });
    }
    if head.schema == 0 {
        return Err(PackageError::malformed(NAME, "schema 0, the first is 1"));
    }
    if strict {
        check_digest(text)?;
    }
    let manifest: Manifest =
        serde_json::from_str(text).map_err(|e| PackageError::malformed(NAME, e.to_string()))?;
    let (_, _, units, frame) = Manifest::fixed();
    if manifest.units != units || manifest.frame != frame {
        return Err(PackageError::malformed(
            NAME,
            format!("units or frame are not those of schema {SCHEMA} (mm, g, s, HU; {frame:?})"),
        ));
    }
    Ok(manifest)
}

fn check_digest(text: &str) -> Result<(), PackageError> {
    let at = text
        .rfind(DIGEST_KEY)
        .ok_or_else(|| PackageError::malformed(NAME, "has no content_sha256 at its end"))?;
    let computed = sha256(&text.as_bytes()[..at]);
    let tail = &text[at..];
    if tail == format!("{DIGEST_KEY}: \"{computed}\"\n}}\n") {
        return Ok(());
    }
    Err(PackageError::Checksum {
        entry: NAME.into(),
        kind: "content digest",
        recorded: tail
            .split('"')
            .nth(3)
            .unwrap_or("unreadable")
            .chars()
            .take(64)
            .collect(),
        computed,
    })
}
