use crate::trace::{Trace, UNCALIBRATED};
use std::fmt::Write;

/// Fiducials at every step: patient RAS mm, step 0 at rest.
pub fn fiducials_csv(trace: &Trace) -> String {
    let mut out = format!(
        "# patient RAS mm; step 0 is the rest position of the package\n# {}\n",
        crate::trace::UNCALIBRATED_MOTION
    );
    out.push_str("step,time_s,stage,indentation_mm");
    for name in &trace.fiducials {
        let name = cell(name);
        let _ = write!(out, ",{name}_x_mm,{name}_y_mm,{name}_z_mm");
    }
    out.push('\n');
    let mut row = |head: String, points: &[[f64; 3]]| {
        out.push_str(&head);
        for v in points.iter().flatten() {
            let _ = write!(out, ",{v:.4}");
        }
        out.push('\n');
    };
    row("0,0,0,0".into(), &trace.fiducials_rest_mm);
    for s in &trace.steps {
        row(
            format!("{},{:.6},{},{:.4}", s.step, s.time_s, s.stage, s.indentation_mm),
            &s.fiducials_mm,
        );
    }
    out
}

/// Contact of every instrument at every step. Vectors in patient axes.
pub fn force_csv(trace: &Trace) -> String {
    let mut out = format!("# {UNCALIBRATED}\n# vectors in patient axes (RAS)\n");
    out.push_str(
        "step,time_s,stage,indentation_mm,instrument,force_x_n,force_y_n,force_z_n,smooth_force_x_n,smooth_force_y_n,\
         smooth_force_z_n,torque_x_n_mm,torque_y_n_mm,torque_z_n_mm,normal_force_n,area_mm2,pressure_kpa,contacts,\
         depth_mm,dent_mean_mm,dent_most_mm\n",
    );
    for s in &trace.steps {
        for (name, c) in trace.instruments.iter().zip(&s.contacts) {
            let _ = write!(
                out,
                "{},{:.6},{},{:.4},{}",
                s.step,
                s.time_s,
                s.stage,
                s.indentation_mm,
                cell(name)
            );
            for v in c.force_n.iter().chain(&c.smooth_force_n).chain(&c.torque_n_mm) {
                let _ = write!(out, ",{v:.6}");
            }
            let _ = writeln!(
                out,
                ",{:.6},{:.3},{:.4},{},{:.4},{},{}",
                c.normal_force_n,
                c.area_mm2,
                c.pressure_kpa,
                c.contacts,
                c.depth_mm,
                known(c.dent_mean_mm),
                known(c.dent_most_mm)
            );
        }
    }
    out
}

/// Wall time of every part of every step, ms.
pub fn timings_csv(trace: &Trace) -> String {
    let mut out = format!(
        "# computed on {}\n\
         # wall time, ms; total_ms = solver_ms + skinning_ms + image_ms; all_collision_ms = neighbours_ms + collision_ms\n\
         # on a GPU parts are times on the device (0 where it takes none), and solver_ms holds the way there and back\n\
         step,time_s,stage",
        trace.device.replace(['\n', '\r'], " ")
    );
    for p in trace.parts() {
        let _ = write!(out, ",{}_ms", p.replace(' ', "_"));
    }
    out.push_str(",solver_ms,all_collision_ms,total_ms\n");
    for s in &trace.steps {
        let _ = write!(out, "{},{:.6},{}", s.step, s.time_s, s.stage);
        let t = &s.times;
        for v in t.parts.iter().chain(&[t.solver_s, t.collision_s(), t.total_s()]) {
            let _ = write!(out, ",{:.4}", v * 1e3);
        }
        out.push('\n');
    }
    out
}

/// A length, or an empty cell where it is not known.
fn known(v: f64) -> String {
    if v.is_finite() {
        format!("{v:.4}")
    } else {
        String::new()
    }
}

/// A name as one cell.
pub(super) fn cell(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r', '#']) {
        format!("\"{}\"", text.replace('"', "\"\"").replace(['\n', '\r'], " "))
    } else {
        text.into()
    }
}
