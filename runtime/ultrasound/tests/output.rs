//! Files: read back by the project's own reader and by the PNG decoder.

mod common;

use common::{Voxels, blocks, package, press};
use palpate_ultrasound::{
    Background, Level, Metadata, Organ, Probe, ProbePose, Scanner, Settings, TissueTable,
};
use palpate_volume::{Affine, ReadLimits, read_ct_from, read_labels_from};

const ORIGIN: [f64; 3] = [41.0, -63.0, 812.0];

fn scanner(level: Level, ct: bool) -> (Scanner, Vec<[f32; 3]>) {
    let (vertices, tets) = blocks([6, 6, 6], 8.0, [-24.0; 3]);
    let v = Voxels::cube(49, 1.0, [0, 1, 2].map(|a| ORIGIN[a] - 24.0));
    let hu = |p: [f64; 3]| (3.0 * (p[0] - ORIGIN[0])) as i16;
    let label = |p: [f64; 3]| if p[2] > ORIGIN[2] { 2 } else { 1 };
    let p = package(
        vertices.clone(),
        tets,
        ORIGIN,
        v,
        &["kidney", "tumour"],
        &label,
        if ct { Some(&hu) } else { None },
    );
    let table = TissueTable::default();
    let settings = Settings {
        level,
        width_px: 120,
        height_px: 90,
        background: Background::Fixed,
        ..Settings::default()
    };
    let organ = Organ::new(&p, &table).unwrap();
    let s = Scanner::new(vec![organ], &table, Probe::default(), settings).unwrap();
    (s, press(&vertices, [0.0, 24.0, 0.0], 4.0, 12.0))
}

fn poses() -> Vec<ProbePose> {
    let tilted = ProbePose::looking(
        [ORIGIN[0] + 3.0, ORIGIN[1] + 22.0, ORIGIN[2]],
        [0.3, -1.0, 0.2],
        [0.5, 0.1, 0.8],
    );
    // Half turns make each term of the quaternion the pivot.
    let mut all = vec![tilted.unwrap()];
    for (axial, lateral) in [
        ([0.0, 1.0, 0.0], [1.0, 0.0, 0.0]),
        ([0.0, -1.0, 0.0], [1.0, 0.0, 0.0]),
        ([0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]),
        ([0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]),
    ] {
        all.push(ProbePose::looking(ORIGIN, axial, lateral).unwrap());
    }
    all
}

/// The reader's affine puts each pixel where the image says it is; sform and qform agree (else the reader warns).
#[test]
fn nifti_slices_carry_their_pose() {
    let (mut s, bent) = scanner(Level::Slice, true);
    for pose in poses() {
        let image = s.slice(&[&bent], &pose).unwrap();
        let bytes = image.label_nifti();
        let (volume, report) =
            read_labels_from(&bytes, "slice.nii", &ReadLimits::default(), &|_| ()).unwrap();
        assert!(report.warnings.is_empty(), "{:?}", report.warnings);
        assert_eq!(volume.dims, [120, 90, 1]);
        for pixel in [[0.0, 0.0], [119.0, 0.0], [17.0, 88.0]] {
            let there = volume.affine.apply([pixel[0], pixel[1], 0.0]);
            let want = image.patient_point(pixel);
            for a in 0..3 {
                assert!((there[a] - want[a]).abs() < 1e-3, "{there:?} {want:?}");
            }
            let (back, off) = image.pixel_of(there);
            assert!(
                (back[0] - pixel[0]).abs() < 0.01 && (back[1] - pixel[1]).abs() < 0.01 && off.abs() < 1e-3
            );
        }
        // The values too, at single pixels: the CT reader rounds.
        let whole = Affine { m: volume.affine.m };
        let (ct, report) = read_ct_from(
            &image.nifti(),
            "hu.nii",
            &ReadLimits::default(),
            [120, 90, 1],
            &whole,
            &|_| (),
        )
        .unwrap();
        assert!(report.warnings.is_empty(), "{:?}", report.warnings);
        assert!(
            ct.hu
                .iter()
                .zip(image.hu())
                .all(|(&a, &b)| (f32::from(a) - b).abs() <= 0.5)
        );
    }
}

#[test]
fn png_holds_the_pixels() {
    let (mut s, bent) = scanner(Level::BMode, true);
    let image = s.image(&[&bent], &poses()[0]).unwrap();
    let bytes = image.png().unwrap();
    let mut reader = png::Decoder::new(std::io::Cursor::new(&bytes))
        .read_info()
        .unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    assert_eq!((info.width, info.height), (120, 90));
    assert_eq!(&pixels[..info.buffer_size()], image.pixels());
    let mm = 1000.0 / f64::from(reader.info().pixel_dims.unwrap().xppu);
    assert!((mm - image.grid().pixel_mm).abs() < 1e-4);
    let bytes = image.nifti();
    assert_eq!(&bytes[352..], image.pixels());
}

#[test]
fn metadata_says_what_the_image_is() {
    for (level, ct) in [
        (Level::Slice, false),
        (Level::Grey, true),
        (Level::Rays, true),
        (Level::BMode, false),
    ] {
        let (mut s, bent) = scanner(level, ct);
        let mut broken = bent.clone();
        broken[0] = [60.0, 60.0, 60.0];
        let pose = poses()[0];
        let image = s.image(&[&broken], &pose).unwrap();
        let m = image.metadata();
        let text = m.json().unwrap();
        assert_eq!(serde_json::from_str::<Metadata>(&text).unwrap(), m);
        assert_eq!((m.level, m.pose), (level, pose));
        assert_eq!(m.organs[0].nominal, !ct);
        let nominal = "no CT; values are nominal ones of the labels' tissues: surroundings: fat, -100 HU, kidney: kidney, 35 HU";
        assert_eq!(m.notes.iter().any(|n| n.contains(nominal)), !ct, "{:?}", m.notes);
        assert_eq!(m.organs[0].nominal_tissues.len(), if ct { 0 } else { 3 });
        assert!(m.notes.iter().any(|n| n.contains("not calibrated")));
        let nifti = image.nifti();
        let description = std::str::from_utf8(&nifti[148..228])
            .unwrap()
            .trim_end_matches('\0');
        assert!(description.contains("not calibrated"), "{description}");
        assert_eq!(description.ends_with("; nominal HU"), !ct, "{description}");
        assert_eq!(
            m.notes.iter().any(|n| n.contains("synthetic")),
            level == Level::BMode
        );
        assert!(m.inverted_tets > 0);
        assert_eq!(
            m.counts.values().sum::<usize>(),
            image.source_counts().iter().sum::<usize>()
        );
        assert!(m.counts["outside"] > 0 && m.counts["mesh"] > 0, "{:?}", m.counts);
        assert!(text.contains("\"depth_mm\": 60.0"));
    }
}

/// Settings of a scene file: what is missing is the default, what is unknown is refused.
#[test]
fn settings_read_from_text() {
    let s: Settings =
        serde_json::from_str(r#"{"level": "b_mode", "acoustic": {"tgc_db_cm_mhz": 0.5}}"#).unwrap();
    assert_eq!(s.level, Level::BMode);
    assert_eq!(s.acoustic.tgc_db_cm_mhz, 0.5);
    assert_eq!(s.width_px, 512);
    assert!(serde_json::from_str::<Settings>(r#"{"levle": "rays"}"#).is_err());
    let p: Probe =
        serde_json::from_str(r#"{"shape": {"curvilinear": {"radius_mm": 50, "field_deg": 60}}}"#).unwrap();
    p.check().unwrap();
    let mut bad = s;
    bad.acoustic.dynamic_range_db = 0.0;
    assert!(
        bad.check()
            .unwrap_err()
            .to_string()
            .contains("dynamic_range_db is 0")
    );
}
