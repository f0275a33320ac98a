use crate::trace::{Contact, StepRow, Trace, UNCALIBRATED, UNCALIBRATED_MOTION};
use std::io::{Cursor, Write};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

/// The session as one file that `numpy.load` opens. Arrays (n steps, i instruments, f fiducials, p parts of a step):
/// `step`, `time_s`, `stage`, `indentation_mm`, `clamps` (n); `fiducials_mm` (n, f, 3), `fiducials_rest_mm` (f, 3),
/// `fiducial_names` (f); `force_n`, `smooth_force_n`, `torque_n_mm` (n, i, 3), `normal_force_n`, `area_mm2`,
/// `pressure_kpa` (n, i), `instrument_names` (i); `timings_s` (n, p), `timing_names` (p), `total_s`, `collision_s` (n);
/// `stage_names`, `stage_last_step`, `stage_indentation_mm`; `device`; `note`, what must not be read into them.
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
    put("instrument_names", texts(&trace.instruments))?;
    let times: Vec<f64> = trace.steps.iter().flat_map(|s| s.times.parts).collect();
    put("timings_s", floats(&[n, trace.parts().len()], &times))?;
    put("timing_names", texts(&trace.parts().map(String::from)))?;
    put("total_s", floats(&[n], &column(&|s| s.times.total_s())))?;
    put("collision_s", floats(&[n], &column(&|s| s.times.collision_s())))?;
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
