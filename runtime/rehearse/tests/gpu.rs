//! Sessions on a GPU beside the CPU's, through the command line where it can be: a software driver will do.

mod common;

use common::{Dir, SCENE};
use palpate_gpu::Gpu;
use palpate_rehearse::scene::SceneSource;
use palpate_rehearse::session::{Device, Session, load};

const GPU: &str = "--backend gpu --allow-software";

fn device() -> Option<Gpu> {
    let gpu = Gpu::for_checks().expect("a device for checks");
    if gpu.is_none() {
        eprintln!("SKIPPED: no GPU adapter; set REQUIRE_GPU=1 to make this a failure");
    }
    gpu
}

/// Numbers of a table's rows.
fn rows(csv: &str) -> Vec<Vec<f64>> {
    csv.lines()
        .filter(|l| l.starts_with(|c: char| c.is_ascii_digit()))
        .map(|l| l.split(',').map(|c| c.parse().unwrap_or(f64::NAN)).collect())
        .collect()
}

/// Largest difference of two tables' columns.
fn apart(a: &str, b: &str, columns: std::ops::Range<usize>) -> f64 {
    let (a, b) = (rows(a), rows(b));
    assert!(!a.is_empty() && a.len() == b.len() && a[0].len() == b[0].len());
    let far = a
        .iter()
        .zip(&b)
        .flat_map(|(a, b)| columns.clone().map(|k| (a[k] - b[k]).abs()));
    far.fold(
        0.0,
        |most, d| if d.is_nan() { f64::INFINITY } else { most.max(d) },
    )
}

/// Share of the pixels of two images that differ by more than one grey value.
fn pixels_apart(d: &Dir, a: &str, b: &str) -> f64 {
    let [a, b] = [a, b].map(|f| std::fs::read(d.path(f)).unwrap());
    assert_eq!(a.len(), b.len());
    assert_eq!(a[..352], b[..352], "headers");
    assert!(a[352..].iter().any(|&p| p > 0), "black");
    let differ = a[352..]
        .iter()
        .zip(&b[352..])
        .filter(|(a, b)| a.abs_diff(**b) > 1);
    differ.count() as f64 / (a.len() - 352) as f64
}

#[test]
fn a_session_on_a_gpu_agrees_with_the_cpus() {
    let Some(gpu) = device() else { return };
    let d = Dir::new();
    d.ok("run s.toml --package k.palpate -o cpu -q --backend cpu");
    let told = d.ok(&format!("run s.toml --package k.palpate -o gpu {GPU}"));
    let name = &gpu.adapter().name;
    assert!(told.contains("24 steps") && told.contains(name), "{told}");
    assert_eq!(d.entries("gpu"), d.entries("cpu"));
    for folder in ["frames", "images", "vtu"] {
        assert_eq!(
            d.entries(&format!("gpu/{folder}")),
            d.entries(&format!("cpu/{folder}"))
        );
    }
    let both = |file: &str| ["cpu", "gpu"].map(|f| d.read(&format!("{f}/{file}")));
    let [a, b] = both("fiducials.csv");
    let far = apart(&a, &b, 4..25);
    assert!(far < 0.01, "{far} mm");
    // Steps, times, stages and indentation are the scene's.
    assert_eq!(apart(&a, &b, 0..4), 0.0);
    let [a, b] = both("force.csv");
    let felt = rows(&a).last().unwrap()[9];
    let far = apart(&a, &b, 5..14);
    assert!(felt > 0.003 && far < 0.05 * felt, "{far} N of {felt}");
    for step in ["06", "08", "12", "18", "24"] {
        let file = |f: &str| format!("{f}/images/image-000{step}.nii");
        let share = pixels_apart(&d, &file("cpu"), &file("gpu"));
        assert!(share < 0.01, "{share} in step {step}");
    }
    let [a, b] = both(
        "vtu/kidney-00024.vtu"
            .replace("kidney-00024.vtu", "kidney.pvd")
            .as_str(),
    );
    assert_eq!(a, b);
    let page = d.read("gpu/summary.html");
    assert!(page.contains(name) && page.contains("made on the GPU"));
    assert!(d.read("gpu/timings.csv").contains(name));
    let times = rows(&d.read("gpu/timings.csv"));
    assert!(times.iter().all(|t| t[13] > 0.0), "total");
    if gpu.has_timestamps() {
        assert!(
            times.iter().all(|t| t[3..11].iter().all(|&ms| ms > 0.0)),
            "{:?}",
            times[0]
        );
    }
    // The recording says what computed it, and the CPU comes to the same.
    let recording: serde_json::Value = serde_json::from_str(&d.read("gpu/recording.json")).unwrap();
    assert_eq!(
        (&recording["backend"], &recording["recording"]),
        (&"gpu".into(), &2.into())
    );
    assert!(recording["device"].as_str().unwrap().contains(name));
    let told = d.ok("replay gpu/recording.json");
    assert!(
        told.contains("24 steps; fiducials of the GPU within 0.00"),
        "{told}"
    );
    // The probe stands 0.5 mm deeper after step 20.
    let mut changed = recording.clone();
    let y = changed["steps"][19]["poses"][0][5].as_f64().unwrap();
    changed["steps"][19]["poses"][0][5] = (y - 0.5).into();
    d.write("changed.json", &changed.to_string());
    let err = d.fails(1, "replay changed.json");
    assert!(err.contains("step 20: fiducials lie"), "{err}");
    let mut changed = recording;
    changed["steps"][3]["fiducials_mm"] = serde_json::json!([]);
    d.write("changed.json", &changed.to_string());
    let err = d.fails(1, "replay changed.json");
    assert!(err.contains("step 4: 0 fiducials"), "{err}");
}

/// What the GPU does not make, the CPU makes of its vertices, and it is said.
#[test]
fn images_beyond_level_0_and_several_organs() {
    let Some(_) = device() else { return };
    let d = Dir::new();
    let second = "[[package]]\npath = 'k.palpate'\n[[package]]\npath = 'k.palpate'\nname = 'other'\noffset_mm = [0, 0, 20]\n";
    for (change, why) in [
        ("level = 'b_mode'", "levels with sound"),
        ("background = 'extrapolate'", "extrapolation"),
        ("", "several organs"),
    ] {
        let scene = SCENE.replace("height_px = 64\n", &format!("height_px = 64\n{change}\n"));
        d.write(
            "s.toml",
            &if change.is_empty() {
                format!("{scene}{second}")
            } else {
                scene
            },
        );
        d.ok("run s.toml --package k.palpate -o cpu -q --backend cpu");
        let told = d.ok(&format!("run s.toml --package k.palpate -o gpu {GPU}"));
        assert!(
            told.contains("The CPU makes the ultrasound image") && told.contains(why),
            "{told}"
        );
        assert!(d.read("gpu/summary.html").contains(why));
        let file = |f: &str| format!("{f}/images/image-00024.nii");
        let share = pixels_apart(&d, &file("cpu"), &file("gpu"));
        assert!(share < 0.02, "{share} with {change}");
        let far = apart(&d.read("cpu/fiducials.csv"), &d.read("gpu/fiducials.csv"), 4..25);
        assert!(far < 0.01, "{far} mm");
    }
}

#[test]
fn auto_takes_no_software_driver() {
    let real = palpate_gpu::adapters().iter().any(|a| a.refused.is_none());
    let d = Dir::new();
    let told = d.ok("run s.toml --package k.palpate -o out");
    assert_eq!(told.contains("on CPU"), !real, "{told}");
    assert_eq!(d.ok("devices").contains("auto takes the CPU"), !real);
    let told = d.ok("bench k.palpate --scene s.toml -q");
    let tables = told.matches("share of each part").count();
    let usable = palpate_gpu::adapters()
        .iter()
        .filter(|a| a.refused.is_none())
        .count();
    assert!(told.starts_with("CPU, ") && tables == 1 + usable, "{told}");
    let Some(gpu) = device() else { return };
    let name = gpu.adapter().name.split_whitespace().next().unwrap().to_string();
    let told = d.ok(&format!(
        "bench k.palpate --scene s.toml -q --backend gpu --adapter {name}"
    ));
    assert!(
        told.starts_with(&gpu.adapter().name) && !told.contains("CPU, "),
        "{told}"
    );
}

#[test]
#[cfg(target_os = "linux")]
fn a_machine_without_drivers_says_what_to_do() {
    let d = Dir::new();
    let without = |args: &str| {
        let mut c = d.command(args);
        c.env("VK_DRIVER_FILES", "/nonexistent")
            .env("WGPU_BACKEND", "vulkan");
        let out = c.output().unwrap();
        (
            out.status.code(),
            String::from_utf8_lossy(&[out.stdout, out.stderr].concat()).into_owned(),
        )
    };
    for flags in ["--backend gpu", GPU, "--adapter llvm"] {
        let (status, told) = without(&format!("run s.toml --package k.palpate -o out {flags}"));
        assert_eq!(status, Some(1), "{told}");
        assert!(
            told.contains("no driver offers an adapter") && told.contains("--backend cpu"),
            "{told}"
        );
    }
    let (status, told) = without("run s.toml --package k.palpate -o out");
    assert!(status == Some(0) && told.contains("on CPU"), "{told}");
    let (_, told) = without("devices");
    assert!(
        told.contains("no driver offers a GPU") && told.contains("auto takes the CPU"),
        "{told}"
    );
}

#[test]
fn a_gpu_that_goes_away_is_told() {
    let Some(gpu) = device() else { return };
    let d = Dir::new();
    let source = SceneSource::read(&d.path("s.toml")).unwrap();
    let (scene, packages) = load(&source, Some(&d.path("k.palpate"))).unwrap();
    let mut session = Session::on(&Device::Gpu(gpu.clone()), scene, &packages).unwrap();
    for _ in 0..3 {
        session.advance_scripted().unwrap();
    }
    gpu.device.destroy();
    let told = session.advance_scripted().unwrap_err().to_string();
    assert!(told.contains("GPU") && told.contains("CPU backend"), "{told}");
    assert!(session.read_back().is_err());
    let camera = session.camera();
    assert!(session.picture(&camera).is_err());
}
