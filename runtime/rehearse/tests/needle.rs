//! Scenes with a needle on a small package.

mod common;

use common::Dir;

/// A fine needle from the front into the tumour of the small package and out again.
const SCENE: &str = "\
name = 'Small biopsy'
model = 'fem'
support = 'cradle'

[cradle]
height_share = 0.4

[tissue]
law = 'neo_hookean'

[[needle]]
name = 'needle'
diameter_mm = 0.5
target = 'tumour'
from = 'anterior'
gap_mm = 1.0
edge_mm = 2.0
free_mm = 8.0
friction_n_per_mm = 0.002
cutting_force_n = 0.01
[[needle.membrane]]
name = 'capsule'
thickness_mm = 0.3
force_n = 0.02
[[needle.motion]]
name = 'in'
reach = 'target'
insertion_mm_s = 8
[[needle.motion]]
name = 'turn'
seconds = 0.2
rotation_degrees = 90
[[needle.motion]]
name = 'out'
reach = 'start'
insertion_mm_s = -8
[[needle.motion]]
name = 'after'
seconds = 1.0

[[instrument]]
name = 'probe'
shape = 'cuboid'
size_mm = [12, 3, 5]
[instrument.pose]
above = 'left'
over = ['tumour']
lateral = 'anterior'
gap_mm = 1.0

[image]
[image.probe]
depth_mm = 14
[image.probe.shape.linear]
width_mm = 12
[image.settings]
width_px = 96
height_px = 96

[view]
width_px = 640
height_px = 360

[record]
frame_every_steps = 20
preview_every_steps = 0
vtu_every_steps = 20
";

struct Row(Vec<(String, String)>);

impl Row {
    fn text(&self, name: &str) -> &str {
        &self
            .0
            .iter()
            .find(|c| c.0 == name)
            .unwrap_or_else(|| panic!("{name}"))
            .1
    }
    fn number(&self, name: &str) -> f64 {
        self.text(name)
            .parse()
            .unwrap_or_else(|_| panic!("{name}: {}", self.text(name)))
    }
}

fn rows(csv: &str) -> Vec<Row> {
    let mut lines = csv.lines().filter(|l| !l.starts_with('#'));
    let head: Vec<&str> = lines.next().unwrap().split(',').collect();
    lines
        .map(|l| {
            Row(head
                .iter()
                .zip(l.split(','))
                .map(|(h, c)| (h.to_string(), c.to_string()))
                .collect())
        })
        .collect()
}

#[test]
fn a_needle_dimples_enters_and_leaves_and_the_organ_recovers() {
    let d = Dir::new();
    d.write("n.toml", SCENE);
    let told = d.ok("check n.toml --package k.palpate");
    assert!(told.contains(": in\n") && told.contains(": after\n"), "{told}");
    d.ok("run n.toml --package k.palpate -o out --threads 1 -q");
    let all = rows(&d.read("out/needle.csv"));
    let at = |event: &str| {
        all.iter()
            .position(|r| r.text("events").contains(event))
            .unwrap_or_else(|| panic!("no event: {event}"))
    };
    let (touch, enter, through, left) = (
        at("touches the surface"),
        at("enters"),
        at("through capsule"),
        at("has left"),
    );
    assert!(touch < enter && enter <= through && through < left);
    // Nothing is felt before, the capsule's 0.02 N (20 % for the needle's own inertia) when it gives way, less just after.
    assert!(all[touch - 1].number("base_axial_n").abs() < 2e-3);
    let gave = all[enter - 1].number("base_axial_n");
    assert!((gave - 0.02).abs() < 0.004, "{gave}");
    let deepest = all.iter().map(|r| r.number("inside_mm")).fold(0.0, f64::max);
    let (most, last) = (
        all.iter()
            .map(|r| r.number("target_moved_mm"))
            .fold(0.0, f64::max),
        all.last().unwrap(),
    );
    assert!(deepest > 1.0 && most > 0.01, "{deepest} {most}");
    // Pulled while it goes back; at rest without it.
    let pulled = all[enter..left]
        .iter()
        .map(|r| r.number("base_axial_n"))
        .fold(0.0, f64::min);
    assert!(pulled < -1e-3, "{pulled}");
    assert!(
        last.number("target_moved_mm") < 0.1 * most,
        "{} of {most}",
        last.number("target_moved_mm")
    );
    assert!(last.number("inside_mm").abs() < 1e-9 && last.text("tip_rest_x_mm").is_empty());
    // The tip ends its way in near the target: the bevel turns it aside by less than tan 10° of the way.
    let nearest = all
        .iter()
        .map(|r| r.number("miss_mm"))
        .fold(f64::INFINITY, f64::min);
    assert!(nearest < 0.5 + 0.18 * deepest, "{nearest} at {deepest}");
    let page = d.read("out/summary.html");
    for part in [
        "miss distance",
        "Push of the sleeve",
        "After turn",
        "coupling",
        "agree with their solution",
    ] {
        assert!(page.contains(part), "{part}");
    }
    assert!(d.entries("out/vtu").iter().any(|g| g == "instrument-needle.pvd"));
    // A white line in the image while it is in.
    let white = |step: u32| {
        let file = std::fs::File::open(d.path(&format!("out/images/image-{step:05}.png"))).unwrap();
        let mut reader = png::Decoder::new(std::io::BufReader::new(file))
            .read_info()
            .unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut pixels).unwrap();
        let wide = info.color_type.samples();
        pixels.chunks(wide).filter(|p| p[0] == 255).count()
    };
    let steps = all.len() as u32;
    let inside = (1..=steps)
        .filter(|s| d.path(&format!("out/images/image-{s:05}.png")).exists())
        .max_by(|a, b| {
            let deep = |s: &u32| all[*s as usize - 1].number("inside_mm");
            deep(a).total_cmp(&deep(b))
        })
        .unwrap();
    assert!(
        white(inside) > 10 + white(steps),
        "{} {}",
        white(inside),
        white(steps)
    );
    // The same on other threads, and repeated.
    d.ok("run n.toml --package k.palpate -o more --threads 3 -q");
    assert!(d.read("out/recording.json") == d.read("more/recording.json"));
    assert!(d.read("out/needle.csv") == d.read("more/needle.csv"));
    let told = d.ok("replay out/recording.json");
    assert!(told.contains("every state the same"), "{told}");
}

#[test]
fn what_a_needle_cannot_do_is_told() {
    let d = Dir::new();
    let fails = |text: &str| {
        d.write("bad.toml", text);
        d.fails(1, "run bad.toml --package k.palpate -o out -q")
    };
    let swapped = |from: &str, to: &str| {
        assert!(SCENE.contains(from), "{from}");
        SCENE.replace(from, to)
    };
    let err = fails(&swapped("target = 'tumour'", "target = 'tumuor'"));
    assert!(
        err.contains("bad.toml:14:") && err.contains("did you mean \"tumour\"?"),
        "{err}"
    );
    let err = fails(&swapped("free_mm = 8.0", "free_mm = 8.0\nlength_mm = 10"));
    assert!(
        err.contains("needle \"needle\" is 10 mm long") && err.contains("make length_mm at least"),
        "{err}"
    );
    // From within: the place of the target itself.
    d.write("n.toml", SCENE);
    d.ok("run n.toml --package k.palpate -o good -q");
    let first = &rows(&d.read("good/needle.csv"))[0];
    let place = ["x", "y", "z"]
        .map(|k| first.text(&format!("target_{k}_mm")).to_string())
        .join(", ");
    let inside = format!("entry_mm = [{place}]\ndirection = 'posterior'");
    let text =
        swapped("target = 'tumour'\nfrom = 'anterior'", &inside).replace("reach = 'target'", "steps = 20");
    let err = fails(&text);
    assert!(
        err.contains("starts inside the tissue") && !d.path("out").exists(),
        "{err}"
    );
    assert_eq!(err, d.fails(1, "check bad.toml --package k.palpate"));
    // Through to the other side: what it did until then is left.
    let err = fails(&swapped("reach = 'target'", "seconds = 6.0"));
    assert!(
        err.contains("would leave the tissue through another side"),
        "{err}"
    );
    let page = d.read("out/summary.html");
    assert!(page.contains("The session stopped: step") && page.contains("enters"));
    let made = rows(&d.read("out/needle.csv")).len();
    assert!(
        d.ok("replay out/recording.json")
            .contains(&format!("{made} steps"))
    );
    // A structure that is held is bone.
    let err = fails(&format!("{SCENE}\n[[hold]]\nstructure = 'tumour'\n"));
    assert!(err.contains("which is rigid (bone)"), "{err}");
}

/// A tip that would pass several tets in a step: the step is made in parts.
#[test]
fn a_thrust_is_made_in_parts() {
    let d = Dir::new();
    let most = |speed: &str, out: &str| {
        d.write("n.toml", &SCENE.replace("insertion_mm_s = 8", speed));
        d.ok(&format!("run n.toml --package k.palpate -o {out} -q"));
        let all = rows(&d.read(&format!("{out}/needle.csv")));
        assert!(all.iter().any(|r| r.text("events").contains("has left")));
        let parts = all.iter().map(|r| r.number("substeps")).fold(0.0, f64::max);
        let deepest = all.iter().map(|r| r.number("inside_mm")).fold(0.0, f64::max);
        (parts, deepest)
    };
    let (slow, fast) = (
        most("insertion_mm_s = 8", "slow"),
        most("insertion_mm_s = 200", "fast"),
    );
    assert!(slow.0 < 4.0 && fast.0 >= 4.0, "{slow:?} {fast:?}");
    // As deep as when it is pushed slowly.
    assert!((slow.1 - fast.1).abs() < 0.5, "{slow:?} {fast:?}");
}

/// The scene with its needle alone and nothing drawn; `needle` writes the entry anew.
fn bare(needles: impl Fn(&str) -> String) -> String {
    let (base, rest) = SCENE.split_once("[[needle]]\n").unwrap();
    let entry = rest.split_once("[[needle.motion]]").unwrap().0;
    let none = "[record]\nframe_every_steps = 0\npreview_every_steps = 0\nvtu_every_steps = 0\n";
    format!("{base}{}{none}", needles(entry))
}

/// In after `wait` seconds, out again after `rest` more.
fn in_and_out(wait: f64, rest: f64) -> String {
    let pause = |s: f64| match s > 0.0 {
        true => format!("[[needle.motion]]\nname = 'rest'\nseconds = {s}\n"),
        false => String::new(),
    };
    format!(
        "{}[[needle.motion]]\nname = 'in'\nreach = 'target'\ninsertion_mm_s = 8\n{}[[needle.motion]]\nname = 'out'\nreach = 'start'\n\
         insertion_mm_s = -8\n[[needle.motion]]\nseconds = 1.0\n",
        pause(wait),
        pause(rest)
    )
}

#[test]
fn two_needles_leave_in_reverse_order_and_are_told_where_they_meet() {
    let d = Dir::new();
    // The second one so many mm beside the first (negative: on its other side), which aims at the tumour's middle.
    let two = |beside: f64, waits: [[f64; 2]; 2]| {
        bare(|entry| {
            let one = |name: &str, target: &str| {
                let named = entry.replace("name = 'needle'", &format!("name = '{name}'"));
                format!("[[needle]]\n{}", named.replace("target = 'tumour'", target))
            };
            let place = format!("target_mm = [{}, 45.5, -309.0]", -77.25 + beside);
            let [[a, b], [c, d]] = waits;
            let first = one("first", "target = 'tumour'") + &in_and_out(a, b);
            first + &one("second", &place) + &in_and_out(c, d)
        })
    };
    let last_first = [[0.0, 3.5], [1.2, 0.2]];
    d.write("two.toml", &two(2.0, last_first));
    d.ok("run two.toml --package k.palpate -o out --threads 1 -q");
    let all = rows(&d.read("out/needle.csv"));
    let of = |name: &str, what: &str| -> f64 {
        let row = all
            .iter()
            .find(|r| r.text("needle") == name && r.text("events").contains(what));
        row.unwrap_or_else(|| panic!("{name} {what}")).number("step")
    };
    let both = ["first", "second"];
    assert!(of("first", "enters") < of("second", "enters"));
    assert!(of("second", "has left") < of("first", "has left"));
    for name in both {
        let deepest = all.iter().filter(|r| r.text("needle") == name);
        let deepest = deepest.map(|r| r.number("inside_mm")).fold(0.0, f64::max);
        assert!(deepest > 1.0, "{name} {deepest}");
    }
    // Both in the tissue at once, and the organ at rest after them.
    let inside = |r: &Row| r.number("inside_mm") > 0.5;
    assert!(all.chunks(2).any(|pair| pair.iter().all(inside)));
    for r in &all[all.len() - 2..] {
        assert!(
            r.number("target_moved_mm") < 0.02,
            "{}",
            r.number("target_moved_mm")
        );
    }
    let page = d.read("out/summary.html");
    assert!(page.contains("<h3>first</h3>") && page.contains("<h3>second</h3>"));
    d.ok("run two.toml --package k.palpate -o more --threads 3 -q");
    assert!(d.read("out/recording.json") == d.read("more/recording.json"));
    // Side by side in the same tets: from the last to the first they leave, the other way round only where they share none.
    d.write("beside.toml", &two(0.8, last_first));
    d.ok("run beside.toml --package k.palpate -o beside -q");
    let mut refused = 0;
    for beside in [-0.6, -0.7, -0.8] {
        let text = two(beside, [[0.0, 1.5], [1.2, 3.5]]);
        d.write("first.toml", &text);
        let ran = d.run("run first.toml --package k.palpate -o first -q");
        if !ran.status.success() {
            let err = String::from_utf8_lossy(&ran.stderr);
            let line = text[..text.find("name = 'out'").unwrap()].lines().count();
            for part in [
                &format!("first.toml:{line}: step ") as &str,
                "needle \"first\" cannot be drawn back further before needle \"second\"",
                "withdraw \"second\" first",
            ] {
                assert!(err.contains(part), "{beside}: {part}: {err}");
            }
            refused += 1;
        }
    }
    assert!(refused > 0);
    // Nearer than they are thick: both are named, with the line of the movement; what was done until then is left.
    let text = two(0.4, last_first);
    d.write("near.toml", &text);
    let err = d.fails(1, "run near.toml --package k.palpate -o near -q");
    let second = text.find("name = 'second'").unwrap();
    let at = second + text[second..].find("name = 'in'").unwrap();
    let line = text[..at].lines().count();
    for part in [
        &format!("near.toml:{line}: step ") as &str,
        "needle \"second\" meets needle \"first\"",
        "or withdraw \"first\" first",
    ] {
        assert!(err.contains(part), "{part}: {err}");
    }
    assert!(d.read("near/summary.html").contains("The session stopped: step"));
}

/// A sleeve that runs on towards the organ folds a thin needle: told with the line of the movement, the place and what to do.
#[test]
fn a_needle_that_bends_back_on_itself_is_told_with_its_line() {
    let d = Dir::new();
    let text = bare(|entry| {
        let thin = entry
            .replace("diameter_mm = 0.5", "diameter_mm = 0.15\nsymmetric = true")
            .replace("free_mm = 8.0", "free_mm = 20.0")
            .replace("friction_n_per_mm = 0.002", "friction_n_per_mm = 0.5")
            .replace("force_n = 0.02", "force_n = 0.0")
            .replace("cutting_force_n = 0.01", "cutting_force_n = 0.001");
        let runs_on = "[[needle.motion]]\nname = 'in'\nreach = 'target'\ninsertion_mm_s = 8\n\
                       [[needle.motion]]\nname = 'runs on'\nseconds = 0.3\nvelocity_mm_s = [20, -400, 0]\n";
        format!("[[needle]]\n{thin}{runs_on}")
    });
    d.write("fold.toml", &text);
    let err = d.fails(1, "run fold.toml --package k.palpate -o out -q");
    let line = text[..text.find("name = 'runs on'").unwrap()].lines().count();
    for part in [
        &format!("fold.toml:{line}: step ") as &str,
        "needle \"needle\": needle bends back on itself at node ",
        "move the base more slowly",
    ] {
        assert!(err.contains(part), "{part}: {err}");
    }
    // Places in the patient, as everywhere else.
    assert!(err.contains(", -30") || err.contains(", -31"), "{err}");
    assert!(d.read("out/summary.html").contains("The session stopped: step"));
}

#[test]
fn a_pre_bent_tip_goes_to_the_side_it_is_bent_to() {
    let d = Dir::new();
    let straight = "symmetric = true\nbevel_towards = 'superior'\n";
    let end = |bend: &str| {
        let text = bare(|entry| {
            let entry = entry.replace(
                "[[needle.membrane]]",
                &format!("{straight}{bend}[[needle.membrane]]"),
            );
            format!("[[needle]]\n{entry}{}", in_and_out(0.0, 0.0))
        });
        d.write("bent.toml", &text);
        d.ok("run bent.toml --package k.palpate -o out -q");
        let all = rows(&d.read("out/needle.csv"));
        let deepest = all
            .iter()
            .max_by(|a, b| a.number("inside_mm").total_cmp(&b.number("inside_mm")))
            .unwrap();
        ["x", "y", "z"].map(|k| deepest.number(&format!("tip_{k}_mm")))
    };
    let plain = end("");
    let bent = |a: f64, b: f64| {
        let tip = end(&format!(
            "pre_bend = [{{ length_mm = 4.0, curvature_per_mm = [{a}, {b}] }}]\n"
        ));
        [tip[0] - plain[0], tip[2] - plain[2]]
    };
    // From the front: the bevel's side is up, and across it is the patient's right. A free arc of 4 mm with radius 20 goes 0.4 mm aside.
    for ([a, b], [x, z]) in [
        ([0.0, 0.05], [0.0, 1.0]),
        ([0.0, -0.05], [0.0, -1.0]),
        ([0.05, 0.0], [1.0, 0.0]),
    ] {
        let moved = bent(a, b);
        let (along, across) = (moved[0] * x + moved[1] * z, moved[0] * z - moved[1] * x);
        assert!(along > 0.25 && along < 0.8, "{moved:?}");
        assert!(across.abs() < 0.25 * along, "{moved:?}");
    }
}

/// What a user gets wrong in figures: each is refused at its line, before anything is computed, or told.
#[test]
fn wrong_figures_of_tissue_and_needle_are_told_with_their_line() {
    let d = Dir::new();
    for (what, found) in [
        ("youngs_modulus_pa = 0", "youngs_modulus_pa is 0"),
        ("youngs_modulus_pa = -5000", "youngs_modulus_pa is -5000"),
        ("poisson_ratio = 0.5", "poisson_ratio is 0.5"),
        ("poisson_ratio = 0.7", "poisson_ratio is 0.7"),
    ] {
        let material = format!("[tissue.material.kidney]\n{what}\n\n[[needle]]\n");
        d.write("bad.toml", &SCENE.replace("[[needle]]\n", &material));
        let err = d.fails(1, "run bad.toml --package k.palpate -o out -q");
        let line = format!(
            "bad.toml:{}: ",
            SCENE.split_once("[[needle]]").unwrap().0.lines().count() + 2
        );
        assert!(err.contains(&line) && err.contains(found), "{what}: {err}");
        assert!(err.contains("expected"), "{what}: {err}");
        assert!(!d.path("out").exists());
    }
    // 10 where 10 000 was meant.
    let soft = "[tissue.material.kidney]\nyoungs_modulus_pa = 10\n\n[[needle]]\n";
    d.write("soft.toml", &SCENE.replace("[[needle]]\n", soft));
    let told = d.ok("check soft.toml --package k.palpate");
    assert!(told.contains("was 10000 Pa"), "{told}");
    // A needle's modulus in GPa.
    let rubber = "edge_mm = 2.0\nyoungs_modulus_pa = 60\n";
    d.write("bad.toml", &SCENE.replace("edge_mm = 2.0\n", rubber));
    let err = d.fails(1, "run bad.toml --package k.palpate -o out -q");
    assert!(
        err.contains("bad.toml:18: ") && err.contains("was GPa meant?"),
        "{err}"
    );
    // A base flung aside pulls the needle out of so small an organ: it is told, and the session goes on.
    let flung = "reach = 'target'\ninsertion_mm_s = 8\n[[needle.motion]]\nname = 'flung'\nseconds = 1.0\nvelocity_mm_s = [400, 0, 0]";
    let text = SCENE.replace("reach = 'target'\ninsertion_mm_s = 8", flung);
    d.write("bad.toml", &text);
    d.ok("run bad.toml --package k.palpate -o out -q");
    let all = rows(&d.read("out/needle.csv"));
    assert!(all.iter().any(|r| r.text("events").contains("has left")));
    assert!(all.iter().all(|r| r.number("tip_x_mm").is_finite()));
}
