use super::*;
use crate::trace::{Contact, StageRow, StepRow, StepTimes, Trace, UNCALIBRATED};
use std::process::Command;

fn trace() -> Trace {
    let steps = (1..=20u32)
        .map(|step| {
            let t = f64::from(step) / 60.0;
            StepRow {
                step,
                time_s: t,
                stage: usize::from(step > 10),
                indentation_mm: 0.5 * f64::from(step.saturating_sub(10)),
                contacts: vec![Contact {
                    force_n: [0.0, -0.1 * t, 0.0],
                    smooth_force_n: [0.0, -0.1 * t, 0.0],
                    area_mm2: 12.5,
                    ..Contact::default()
                }],
                times: StepTimes {
                    parts: [1e-3, 2e-3, 3e-3, 1e-3, 4e-3, 0.5e-3, 0.25e-3, 2e-3],
                    solver_s: 0.0115,
                },
                fiducials_mm: vec![[1.0, 2.0 - t, 3.0], [4.0, 5.0, 6.0 + t]],
                clamps: 0,
                inverted_tets: 0,
                digest: u64::from(step),
                ..StepRow::default()
            }
        })
        .collect();
    Trace {
        device: "CPU, 2 threads".into(),
        fem: false,
        needles: Vec::new(),
        instruments: vec!["probe, left".into()],
        fiducials: vec!["a".into(), "b\u{e9}".into()],
        fiducials_rest_mm: vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
        stages: vec![
            StageRow {
                name: "warm-up".into(),
                indentation_mm: 0.0,
                last_step: 10,
            },
            StageRow {
                name: "5 <mm>".into(),
                indentation_mm: 5.0,
                last_step: 20,
            },
        ],
        steps,
    }
}

#[test]
fn tables_have_as_many_cells_as_headings_and_say_what_is_not_calibrated() {
    let t = trace();
    let rows = |text: &str| -> Vec<Vec<String>> {
        text.lines()
            .filter(|l| !l.starts_with('#'))
            .map(|l| {
                l.replace("\"probe, left\"", "probe")
                    .split(',')
                    .map(String::from)
                    .collect()
            })
            .collect()
    };
    for (text, count) in [
        (fiducials_csv(&t), 22),
        (force_csv(&t), 21),
        (timings_csv(&t), 21),
    ] {
        let rows = rows(&text);
        assert_eq!(rows.len(), count);
        assert!(rows.iter().all(|r| r.len() == rows[0].len()), "{text}");
    }
    assert!(force_csv(&t).contains(UNCALIBRATED));
    let last = rows(&fiducials_csv(&t)).pop().unwrap();
    assert_eq!(last[3..6], ["5.0000", "1.0000", "1.6667"]);
    let times = rows(&timings_csv(&t)).pop().unwrap();
    // Solver, finding contacts, all.
    assert_eq!(times[11..], ["11.5000", "5.0000", "13.7500"]);
}

#[test]
fn displacements_between_stages() {
    let t = trace();
    let d = t.displacements(Some(0), 1);
    assert!(d.iter().all(|d| (d - 10.0 / 60.0).abs() < 1e-12), "{d:?}");
    assert!(
        t.displacements(None, 0)
            .iter()
            .all(|d| (d - 10.0 / 60.0).abs() < 1e-12)
    );
    assert!(t.displacements(Some(0), 7).is_empty());
}

#[test]
fn the_page_holds_its_figures_and_escapes_names() {
    let t = trace();
    let page = summary_html(&SummaryInput {
        pictures: &[("end".into(), vec![1, 2, 3])],
        preview: &[9],
        ..SummaryInput::new("A & B", &t)
    });
    for part in [
        "A &amp; B",
        UNCALIBRATED,
        "data:image/png;base64,AQID",
        "5 &lt;mm&gt;",
        "Figure 8",
        "<td>13.75</td>",
    ] {
        assert!(page.contains(part), "{part}");
    }
    assert!(!page.contains("NaN") && !page.contains("<mm>") && !page.contains("http"));
}

#[test]
fn an_output_folder_appears_whole_or_not_at_all() {
    let dir = tempfile::tempdir().unwrap();
    let place = dir.path().join("deep/out");
    let out = OutputFolder::new(&place).unwrap();
    out.write("frames/a.png", b"1").unwrap();
    assert!(!place.exists());
    drop(out);
    assert_eq!(std::fs::read_dir(dir.path().join("deep")).unwrap().count(), 0);
    for text in ["one", "two"] {
        let out = OutputFolder::new(&place).unwrap();
        out.write("recording.json", text.as_bytes()).unwrap();
        out.finish().unwrap();
        assert_eq!(
            std::fs::read_to_string(place.join("recording.json")).unwrap(),
            text
        );
        assert_eq!(std::fs::read_dir(dir.path().join("deep")).unwrap().count(), 1);
    }
    // A folder with other things in it is left alone.
    std::fs::remove_file(place.join("recording.json")).unwrap();
    std::fs::write(place.join("thesis.tex"), b"x").unwrap();
    let refused = OutputFolder::new(&place).unwrap_err().to_string();
    assert!(refused.contains("no earlier output"), "{refused}");
    assert!(place.join("thesis.tex").exists());
}

/// numpy and VTK as independent readers, where `PALPATE_PYTHON` names an interpreter that has them.
#[test]
fn python_reads_the_array_file_and_the_grids() {
    let dir = tempfile::tempdir().unwrap();
    let t = trace();
    std::fs::write(dir.path().join("t.npz"), trace_npz(&t).unwrap()).unwrap();
    let triangles = [[0, 1, 2], [0, 2, 3]];
    let cloud = PointCloud {
        points_mm: vec![[0.0; 3], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.5]],
        triangles: &triangles,
        arrays: vec![
            VtuArray::Scalars("speed <mm/s>".into(), vec![1.0, 2.0, 3.0, 4.5]),
            VtuArray::Vectors("displacement_mm".into(), vec![[0.5, 1.0, -2.0]; 4]),
        ],
        ..PointCloud::default()
    };
    let tet = PointCloud {
        triangles: &[],
        tets: vec![[0, 1, 2, 3]],
        cells: vec![VtuArray::Scalars("region".into(), vec![3.0])],
        ..cloud.clone()
    };
    std::fs::write(dir.path().join("t.vtu"), vtu(&tet, 0.0)).unwrap();
    std::fs::write(dir.path().join("s.vtu"), vtu(&cloud, 0.25)).unwrap();
    let bare = PointCloud {
        triangles: &[],
        ..cloud
    };
    std::fs::write(dir.path().join("p.vtu"), vtu(&bare, 0.5)).unwrap();
    std::fs::write(
        dir.path().join("s.pvd"),
        pvd(&[(0.25, "s.vtu".into()), (0.5, "p.vtu".into())]),
    )
    .unwrap();
    let Some(python) = std::env::var_os("PALPATE_PYTHON") else {
        eprintln!("SKIPPED: PALPATE_PYTHON is not set; numpy and VTK did not read the files");
        return;
    };
    let script = "\
import numpy as n
t = n.load('t.npz')
assert t['fiducials_mm'].shape == (20, 2, 3) and t['force_n'].shape == (20, 1, 3), t['force_n'].shape
assert abs(t['fiducials_mm'][19, 1, 2] - 6 - 1/3) < 1e-12 and t['fiducial_names'].tolist() == ['a', 'b\\u00e9']
assert t['timings_s'].shape == (20, 8) and t['timing_names'][4] == 'shape matching'
assert abs(t['total_s'][3] - 0.01375) < 1e-12 and all('not calibrated' in str(n) for n in t['note'])
assert t['device'].tolist() == ['CPU, 2 threads']
try:
    import pyvista as p
except ImportError:
    print('no pyvista'); raise SystemExit
s = p.read('s.vtu')
assert s.n_points == 4 and s.n_cells == 2 and abs(s.area - 1.0) < 0.2, s.area
assert s['speed <mm/s>'].tolist() == [1, 2, 3, 4.5] and s['displacement_mm'][2].tolist() == [0.5, 1, -2]
assert p.read('p.vtu').n_cells == 4
t = p.read('t.vtu')
assert t.n_cells == 1 and abs(t.volume - 1 / 12) < 1e-9 and t.cell_data['region'].tolist() == [3]
r = p.PVDReader('s.pvd')
assert r.time_values == [0.25, 0.5]
";
    let run = Command::new(python)
        .args(["-c", script])
        .current_dir(dir.path())
        .output()
        .unwrap();
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
}

#[test]
fn dents_are_told_where_they_are_known_and_what_a_release_leaves() {
    let mut t = trace();
    for s in &mut t.steps {
        let depth = 0.5 * s.indentation_mm;
        s.contacts[0].dent_mean_mm = if s.step == 3 { f64::NAN } else { 0.5 * depth };
        s.contacts[0].dent_most_mm = if s.step == 3 { f64::NAN } else { depth };
    }
    let csv = force_csv(&t);
    let rows: Vec<&str> = csv.lines().filter(|l| !l.starts_with('#')).collect();
    assert!(rows[0].ends_with(",dent_mean_mm,dent_most_mm"));
    assert!(
        rows[3].ends_with(",,") && rows[20].ends_with(",1.2500,2.5000"),
        "{}",
        rows[20]
    );
    let html = summary_html(&SummaryInput::new("t", &t));
    assert!(html.contains("<td>1.25, 2.50</td>") && !html.contains("Left after release"));
    t.stages[1].indentation_mm = -8.0;
    let html = summary_html(&SummaryInput::new("t", &t));
    // b goes 10/60 mm from step 10 to step 20, a as far.
    assert!(
        html.contains("Left after release: fiducials 0.17 mm off"),
        "{html}"
    );
    assert!(html.contains("dent of probe, left (mean, most) 1.25, 2.50 mm."));
    for s in &mut t.steps {
        s.contacts[0].dent_mean_mm = f64::NAN;
        s.contacts[0].dent_most_mm = f64::NAN;
    }
    let html = summary_html(&SummaryInput::new("t", &t));
    assert!(!html.contains("Dent, deepest"));
}
