use crate::trace::{Contact, Coupling, NeedleStep, StepRow, Trace, UNCALIBRATED, UNCALIBRATED_MOTION};
use std::io::{Cursor, Write};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

/// The session as one file that `numpy.load` opens. Arrays (n steps, i instruments, f fiducials, p parts of a step):
/// `step`, `time_s`, `stage`, `indentation_mm`, `clamps` (n); `fiducials_mm` (n, f, 3), `fiducials_rest_mm` (f, 3),
/// `fiducial_names` (f); `force_n`, `smooth_force_n`, `torque_n_mm` (n, i, 3), `normal_force_n`, `area_mm2`,
/// `pressure_kpa`, `dent_mean_mm`, `dent_most_mm` (n, i), `instrument_names` (i); `timings_s` (n, p), `timing_names` (p),
/// `total_s`, `collision_s` (n); `stage_names`, `stage_last_step`, `stage_indentation_mm`; with needles `needle_*`;
/// `device`; `note`, what must not be read into them.
///
/// # Errors
/// The zip writer's: only where the file would pass 4 GiB.
pub fn trace_npz(trace: &Trace) -> zip::result::ZipResult<Vec<u8>> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default()
        .compression_method(CompressionMethod::Stored)
        .last_modified_time(zip::DateTime::default());
    let mut put = |name: &str, bytes: Vec<u8>| -> zip::result::ZipResult<()> {
        zip.start_file(format!("{name}.npy"), options)?;
        zip.write_all(&bytes)?;
        Ok(())
    };
    let (n, i, f) = (trace.steps.len(), trace.instruments.len(), trace.fiducials.len());
    let column = |get: &dyn Fn(&StepRow) -> f64| -> Vec<f64> { trace.steps.iter().map(get).collect() };
    put("step", floats(&[n], &column(&|s| f64::from(s.step))))?;
    put("time_s", floats(&[n], &column(&|s| s.time_s)))?;
    put("stage", floats(&[n], &column(&|s| s.stage as f64)))?;
    put("indentation_mm", floats(&[n], &column(&|s| s.indentation_mm)))?;
    put("clamps", floats(&[n], &column(&|s| s.clamps as f64)))?;
    let points: Vec<f64> = trace
        .steps
        .iter()
        .flat_map(|s| s.fiducials_mm.iter().flatten())
        .copied()
        .collect();
    put("fiducials_mm", floats(&[n, f, 3], &points))?;
    let rest: Vec<f64> = trace.fiducials_rest_mm.iter().flatten().copied().collect();
    put("fiducials_rest_mm", floats(&[f, 3], &rest))?;
    put("fiducial_names", texts(&trace.fiducials))?;
    let vectors = |get: &dyn Fn(&Contact) -> [f64; 3]| -> Vec<f64> {
        trace
            .steps
            .iter()
            .flat_map(|s| &s.contacts)
            .flat_map(get)
            .collect()
    };
    put("force_n", floats(&[n, i, 3], &vectors(&|c| c.force_n)))?;
    put(
        "smooth_force_n",
        floats(&[n, i, 3], &vectors(&|c| c.smooth_force_n)),
    )?;
    put("torque_n_mm", floats(&[n, i, 3], &vectors(&|c| c.torque_n_mm)))?;
    let scalars = |get: &dyn Fn(&Contact) -> f64| -> Vec<f64> {
        trace.steps.iter().flat_map(|s| &s.contacts).map(get).collect()
    };
    put("normal_force_n", floats(&[n, i], &scalars(&|c| c.normal_force_n)))?;
    put("area_mm2", floats(&[n, i], &scalars(&|c| c.area_mm2)))?;
    put("pressure_kpa", floats(&[n, i], &scalars(&|c| c.pressure_kpa)))?;
    put("dent_mean_mm", floats(&[n, i], &scalars(&|c| c.dent_mean_mm)))?;
    put("dent_most_mm", floats(&[n, i], &scalars(&|c| c.dent_most_mm)))?;
    put("instrument_names", texts(&trace.instruments))?;
    let times: Vec<f64> = trace.steps.iter().flat_map(|s| s.times.parts).collect();
    put("timings_s", floats(&[n, trace.parts().len()], &times))?;
    put("timing_names", texts(&trace.parts().map(String::from)))?;
    put("total_s", floats(&[n], &column(&|s| s.times.total_s())))?;
    put("collision_s", floats(&[n], &column(&|s| s.times.collision_s())))?;
    needles(&mut put, trace)?;
    let stages = trace.stages.len();
    let names: Vec<String> = trace.stages.iter().map(|s| s.name.clone()).collect();
    put("stage_names", texts(&names))?;
    let ends: Vec<f64> = trace.stages.iter().map(|s| f64::from(s.last_step)).collect();
    put("stage_last_step", floats(&[stages], &ends))?;
    let depths: Vec<f64> = trace.stages.iter().map(|s| s.indentation_mm).collect();
    put("stage_indentation_mm", floats(&[stages], &depths))?;
    put("device", texts(std::slice::from_ref(&trace.device)))?;
    put(
        "note",
        texts(&[UNCALIBRATED, UNCALIBRATED_MOTION].map(String::from)),
    )?;
    Ok(zip.finish()?.into_inner())
}

/// With needles (k): `needle_names` (k); `needle_fed_mm`, `needle_inside_mm`, `needle_axial_n` (n, k); `needle_force_n`,
/// `needle_tip_mm`, `needle_target_mm` (n, k, 3; NaN without a target); `needle_trials`, `needle_iterations`, `needle_substeps` (n).
fn needles(
    put: &mut dyn FnMut(&str, Vec<u8>) -> zip::result::ZipResult<()>,
    trace: &Trace,
) -> zip::result::ZipResult<()> {
    let (n, k) = (trace.steps.len(), trace.needles.len());
    if k == 0 {
        return Ok(());
    }
    let names: Vec<String> = trace.needles.iter().map(|n| n.name.clone()).collect();
    put("needle_names", texts(&names))?;
    let each = |get: &dyn Fn(&NeedleStep) -> f64| -> Vec<f64> {
        trace.steps.iter().flat_map(|s| &s.needles).map(get).collect()
    };
    put("needle_fed_mm", floats(&[n, k], &each(&|s| s.fed_mm)))?;
    put("needle_inside_mm", floats(&[n, k], &each(&|s| s.inside_mm)))?;
    put("needle_axial_n", floats(&[n, k], &each(&|s| s.base_axial_n)))?;
    let vectors = |get: &dyn Fn(&NeedleStep) -> [f64; 3]| -> Vec<f64> {
        trace
            .steps
            .iter()
            .flat_map(|s| &s.needles)
            .flat_map(get)
            .collect()
    };
    put(
        "needle_force_n",
        floats(&[n, k, 3], &vectors(&|s| s.base_force_n)),
    )?;
    put("needle_tip_mm", floats(&[n, k, 3], &vectors(&|s| s.tip_mm)))?;
    let target = |s: &NeedleStep| s.target_mm.unwrap_or([f64::NAN; 3]);
    put("needle_target_mm", floats(&[n, k, 3], &vectors(&target)))?;
    let solved = |get: &dyn Fn(&Coupling) -> u32| -> Vec<f64> {
        let row = |s: &StepRow| f64::from(s.coupling.as_ref().map_or(0, get));
        trace.steps.iter().map(row).collect()
    };
    put("needle_trials", floats(&[n], &solved(&|c| c.trials)))?;
    put("needle_iterations", floats(&[n], &solved(&|c| c.iterations)))?;
    put("needle_substeps", floats(&[n], &solved(&|c| c.substeps)))
}

fn header(dtype: &str, shape: &[usize]) -> Vec<u8> {
    let dims: String = shape.iter().map(|d| format!("{d}, ")).collect();
    let mut text = format!("{{'descr': '{dtype}', 'fortran_order': False, 'shape': ({dims}), }}");
    // Data start at a multiple of 64 bytes, the header ends with a line feed.
    let padded = (10 + text.len() + 1).next_multiple_of(64) - 10;
    text.extend(std::iter::repeat_n(' ', padded - 1 - text.len()));
    text.push('\n');
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((text.len() as u16).to_le_bytes());
    out.extend(text.as_bytes());
    out
}

fn floats(shape: &[usize], values: &[f64]) -> Vec<u8> {
    let mut out = header("<f8", shape);
    out.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    out
}

/// Fixed-width text, four bytes a character.
fn texts(values: &[String]) -> Vec<u8> {
    let width = values.iter().map(|v| v.chars().count()).max().unwrap_or(0).max(1);
    let mut out = header(&format!("<U{width}"), &[values.len()]);
    for v in values {
        let padded = v.chars().map(u32::from).chain(std::iter::repeat(0)).take(width);
        out.extend(padded.flat_map(u32::to_le_bytes));
    }
    out
}
