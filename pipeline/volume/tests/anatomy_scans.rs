//! The volume stage on real scans (found through `PALPATE_DATA`).

mod common;

use common::{Scan, data_folder, field_to_mask, mask_to_field, read_scan};
use palpate_volume::{
    Anatomy, AnatomySelection, ComponentChoice, RegionSelection, VolumeParams, VolumeReport, build_anatomy,
};

fn kits(component: ComponentChoice) -> AnatomySelection {
    AnatomySelection {
        organ: RegionSelection {
            name: "kidney".into(),
            labels: vec![1],
        },
        structures: vec![RegionSelection {
            name: "tumour".into(),
            labels: vec![2],
        }],
        supports: vec![],
        component,
    }
}

fn build(scan: &Scan, selection: &AnatomySelection, params: &VolumeParams) -> (Anatomy, VolumeReport) {
    let start = std::time::Instant::now();
    let out = build_anatomy(&scan.grid(), selection, params, &|_, _| {}).expect("the scan builds");
    println!("  built in {:.2} s", start.elapsed().as_secs_f64());
    out
}

#[test]
fn kits_cases() {
    let Some(data) = data_folder("kits_cases") else {
        return;
    };
    for case in [0, 4, 5, 24, 32, 42, 123, 151] {
        if std::env::var("CASE").is_ok_and(|c| c != case.to_string()) {
            continue;
        }
        let scan = read_scan(&data.join(format!("kits19/case_{case:05}_segmentation.nii.gz")));
        let mut number = 1;
        loop {
            let selection = kits(ComponentChoice::Index(number));
            let (anatomy, report) = build(&scan, &selection, &VolumeParams::default());
            println!(
                "case {case} component {number} {}",
                serde_json::to_string(&report).unwrap()
            );
            let none = |_: [f64; 3]| false;
            let organ = &anatomy.organ;
            println!(
                "  mask→field {:?}",
                mask_to_field(&organ.mask, &organ.field, &[0, 1, 2], &none)
            );
            println!(
                "  field→mask {:?}",
                field_to_mask(&organ.drawn, &organ.field, &none)
            );
            for s in &anatomy.structures {
                println!(
                    "  {} {:?}",
                    s.body.name,
                    mask_to_field(&s.body.mask, &s.body.field, &[0, 1, 2], &none)
                );
            }
            if number == anatomy.components.len() {
                break;
            }
            number += 1;
        }
    }
}
