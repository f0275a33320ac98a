//! Devices, kernels and recordings on whatever adapter there is.

use palpate_gpu::{Batch, Choice, Demand, Gpu, GpuError, Kernel, Piece, Recording, Shader, wgpu};

const SCALE: &str = "
struct Settings { factor: f32, count: u32 }
@group(0) @binding(0) var<storage, read> input: array<f32>;
@group(0) @binding(1) var<storage, read_write> output: array<f32>;
@group(0) @binding(2) var<uniform> settings: Settings;
override shift: f32 = 0.0;
@compute @workgroup_size(64)
fn scale(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = id.x + id.y * 65535u * 64u;
    if i < settings.count { output[i] = settings.factor * input[i] + shift; }
}
@compute @workgroup_size(64)
fn square(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = id.x + id.y * 65535u * 64u;
    if i < settings.count { output[i] = output[i] * output[i]; }
}
";

fn device() -> Option<Gpu> {
    let gpu = Gpu::for_checks().expect("a device for checks");
    if gpu.is_none() {
        eprintln!("SKIPPED: no GPU adapter; set REQUIRE_GPU=1 to make this a failure");
    }
    gpu
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct Settings {
    factor: f32,
    count: u32,
}

/// 2·x + 1 squared, for more elements than one row of workgroups holds.
#[test]
fn a_recording_runs_in_order_and_repeats() {
    let Some(gpu) = device() else { return };
    let n = 65_535 * 64 + 1000;
    let values: Vec<f32> = (0..n).map(|i| (i % 1000) as f32).collect();
    let shader = Shader::new("scale.wgsl", &[SCALE]).expect("shader");
    let scale = Kernel::new(&gpu, &shader, "scale", &[("shift", 1.0)]).expect("scale");
    let square = Kernel::new(&gpu, &shader, "square", &[]).expect("square");
    let input = gpu.storage("input", &values).expect("input");
    let output = gpu.storage_zeroed("output", 4 * n as u64).expect("output");
    let settings = gpu
        .uniform(
            "settings",
            &Settings {
                factor: 2.0,
                count: n as u32,
            },
        )
        .expect("settings");
    let first = scale
        .bind(&gpu, &[(0, &input), (1, &output), (2, &settings)])
        .expect("bind");
    let second = square.bind(&gpu, &[(1, &output), (2, &settings)]).expect("bind");
    let mut recording = Recording::new();
    recording.run("scale", &scale, &first, n);
    recording.run("square", &square, &second, n);
    for timed in [false, true, false] {
        if timed {
            let times = recording.submit_timed(&gpu).expect("timed");
            if let Some(times) = times {
                let names: Vec<_> = times.iter().map(|t| t.part.as_str()).collect();
                assert_eq!(names, ["scale", "square"]);
                assert!(times.iter().all(|t| t.ms > 0.0), "{times:?}");
            }
        } else {
            recording.submit(&gpu).expect("submit");
        }
        let back: Vec<f32> = gpu.read(&output, n).expect("read");
        let wrong = back
            .iter()
            .zip(&values)
            .position(|(b, v)| *b != (2.0 * v + 1.0).powi(2));
        assert_eq!(wrong, None);
    }
}

#[test]
fn faults_are_errors() {
    let Some(gpu) = device() else { return };
    let most = gpu
        .device
        .limits()
        .max_storage_buffer_binding_size
        .min(gpu.device.limits().max_buffer_size);
    assert!(matches!(
        gpu.storage_zeroed("huge", most + 1),
        Err(GpuError::BufferTooLarge { .. })
    ));
    let shader = Shader::new("scale.wgsl", &[SCALE]).expect("shader");
    assert!(matches!(
        Kernel::new(&gpu, &shader, "missing", &[]),
        Err(GpuError::Shader { .. })
    ));
    let kernel = Kernel::new(&gpu, &shader, "scale", &[]).expect("kernel");
    let buffer = gpu.storage("a", &[1.0f32]).expect("buffer");
    assert!(matches!(
        kernel.bind(&gpu, &[(0, &buffer)]),
        Err(GpuError::Refused { .. })
    ));
    assert!(matches!(
        gpu.read::<f32>(&buffer, 1 << 20),
        Err(GpuError::Refused { .. })
    ));
    // A refused call inside a guard leaves the device usable.
    assert_eq!(gpu.read::<f32>(&buffer, 1).expect("read"), [1.0]);
    gpu.device.destroy();
    let after = gpu.read::<f32>(&buffer, 1).expect_err("a destroyed device");
    assert!(
        matches!(after, GpuError::Lost { .. } | GpuError::Refused { .. }),
        "{after}"
    );
}

#[test]
fn an_unknown_name_lists_what_there_is() {
    let error = Gpu::open(&Choice::Named("no such card".into())).expect_err("no such card");
    assert!(error.to_string().contains("no such card"), "{error}");
    assert!(error.to_string().contains("CPU backend"), "{error}");
}

#[test]
fn a_broken_shader_names_file_and_line() {
    let error = Shader::new("broken.wgsl", &["fn f() -> f32 {\n  let x = ;\n}"]).expect_err("does not parse");
    let text = error.to_string();
    assert!(text.contains("broken.wgsl:2"), "{text}");
}

#[test]
fn entry_points_state_what_they_use() {
    let shader = Shader::new("scale.wgsl", &[SCALE]).expect("shader");
    let scale = shader.entry_point("scale").expect("scale");
    assert_eq!(
        (scale.workgroup_size, scale.storage_buffers, scale.workgroup_bytes),
        ([64, 1, 1], 2, 0)
    );
    assert_eq!(shader.entry_point("square").expect("square").storage_buffers, 1);
    let layout = shader.struct_layout("Settings").expect("Settings");
    assert_eq!(layout.size as usize, size_of::<Settings>());
    assert_eq!(
        layout.members[1].offset as usize,
        std::mem::offset_of!(Settings, count)
    );
}

/// Two recordings in one submission, pieces of what they wrote, times with both kinds of timestamps.
#[test]
fn a_batch_reads_its_pieces_back() {
    let Some(gpu) = device() else { return };
    let between = Demand {
        wanted: wgpu::Features::TIMESTAMP_QUERY,
        ..Demand::default()
    };
    let other = Gpu::open_with(&Choice::Any, &between).expect("a second device");
    for gpu in [gpu, other] {
        let n = 1000;
        let values: Vec<f32> = (0..n).map(|i| i as f32).collect();
        let shader = Shader::new("scale.wgsl", &[SCALE]).expect("shader");
        let scale = Kernel::new(&gpu, &shader, "scale", &[("shift", 1.0)]).expect("scale");
        let square = Kernel::new(&gpu, &shader, "square", &[]).expect("square");
        let input = gpu.storage("input", &values).expect("input");
        let output = gpu.storage_zeroed("output", 4 * n as u64).expect("output");
        let settings = Settings {
            factor: 2.0,
            count: n as u32,
        };
        let uniform = gpu.uniform("settings", &settings).expect("settings");
        let (mut first, mut second) = (Recording::new(), Recording::new());
        let bound = scale
            .bind(&gpu, &[(0, &input), (1, &output), (2, &uniform)])
            .expect("bind");
        first.run("scale", &scale, &bound, n);
        let bound = square.bind(&gpu, &[(1, &output), (2, &uniform)]).expect("bind");
        second.run("square", &square, &bound, n);
        second.run("scale", &square, &bound, n);
        let piece = |offset, bytes| Piece {
            buffer: output.clone(),
            offset,
            bytes,
        };
        let pieces = [piece(4 * 500, 8), piece(0, 0), piece(12, 4)];
        let mut batch = Batch::new(&gpu, &[&first, &second], &pieces, true).expect("batch");
        for factor in [2.0f32, 3.0] {
            gpu.write(&uniform, 0, &[Settings { factor, ..settings }]);
            batch.run(&gpu).expect("run");
            let at = |i: f32| (factor * i + 1.0).powi(4).to_le_bytes();
            assert_eq!(batch.piece(0), [at(500.0), at(501.0)].concat());
            assert_eq!(batch.piece(1), [0u8; 0]);
            assert_eq!(batch.piece(2), at(3.0));
            assert_eq!(batch.piece(3), [0u8; 0]);
        }
        let times = batch
            .times()
            .map(|t| t.iter().map(|t| t.part.as_str()).collect::<Vec<_>>());
        assert_eq!(
            times,
            gpu.has_timestamps().then(|| vec!["scale", "square"]),
            "{:?}",
            batch.times()
        );
        assert!(Batch::new(&gpu, &[&first], &[piece(4 * n as u64, 4)], false).is_err());
        assert!(Batch::new(&gpu, &[&first], &[piece(2, 4)], false).is_err());
    }
}

#[test]
fn an_adapter_below_the_demand_is_refused() {
    if device().is_none() {
        return;
    }
    let demand = Demand {
        limits: wgpu::Limits {
            max_compute_invocations_per_workgroup: 1 << 20,
            ..wgpu::Limits::default()
        },
        ..Demand::default()
    };
    let error = Gpu::open_with(&Choice::Any, &demand).expect_err("absurd limits");
    assert!(
        matches!(&error, GpuError::LimitTooSmall { limit, needed: 0x100000, .. } if limit.contains("Invocations")),
        "{error}"
    );
    assert!(error.to_string().contains("CPU backend"), "{error}");
    let error = Gpu::open(&Choice::Number(1000)).expect_err("no such adapter");
    assert!(matches!(error, GpuError::NoAdapter { .. }), "{error}");
}
