//! Writes to buffers, and timestamps that stand still.

use super::{opened, shared};
use crate::flow::gpu::memory::GpuOptions;
use crate::flow::gpu::phase::Clock;

#[test]
fn contents_that_are_uploaded_in_pieces_arrive_whole_and_in_order() {
    let Some(gpu) = shared() else {
        return;
    };
    let context = &gpu.device().context;
    let usage = wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST;
    let first: Vec<u32> = (1..=40).collect();
    let second: Vec<u32> = (100..=106).collect();
    // Less than a write, one and a half writes, and all writes.
    for most in [20, 240, 1024] {
        let buffer = context.empty(256, usage).expect("a small buffer");
        let writes = [
            (&buffer, 0, bytemuck::cast_slice(&first)),
            (&buffer, 200, bytemuck::cast_slice(&second)),
            // The last of two writes to a place is the one that counts.
            (&buffer, 4, bytemuck::cast_slice(&second[..1])),
        ];
        context.write_in_pieces(&writes, most).expect("it fits");
        let read = context.finish(context.encoder(), &buffer, 256);
        let read = read.expect("an answer");
        let words: &[u32] = bytemuck::cast_slice(&read);
        let mut expected = [0; 64];
        expected[..40].copy_from_slice(&first);
        expected[50..57].copy_from_slice(&second);
        expected[1] = 100;
        assert_eq!(words, expected, "{most}");
    }
    let buffer = context.empty(16, usage).expect("a small buffer");
    context.write(&[]).expect("nothing to write");
    context
        .write(&[(&buffer, 0, &[])])
        .expect("nothing to write");
}

#[test]
fn timestamps_that_stand_still_or_go_back_give_no_speed() {
    let Some(gpu) = shared() else {
        return;
    };
    let clock = Clock::new(&gpu.device().context, 2).expect("a small buffer");
    let Some(clock) = clock else {
        return;
    };
    let seconds = |moments: [u64; 2]| clock.seconds(bytemuck::cast_slice(&moments), 0, 1);
    assert_eq!(seconds([0, 0]), None);
    assert_eq!(seconds([9, 8]), None);
    assert!(seconds([8, 9]).is_some_and(|seconds| seconds > 0.0));
}

#[test]
fn a_destroyed_device_gives_its_memory_back_though_others_hold_it() {
    let options = GpuOptions {
        memory_bytes: Some(600 << 20),
        ..GpuOptions::default()
    };
    let Some(gpu) = opened(&options) else {
        return;
    };
    let other_lane = gpu.clone();
    let allocated = || {
        let report = other_lane
            .device()
            .context
            .device
            .generate_allocator_report();
        report.expect("the driver reports it").total_allocated_bytes
    };
    let before = allocated();
    assert!(before >= gpu.memory_bytes(), "{before}");
    gpu.destroy();
    let after = allocated();
    assert!(after < before / 10, "{after} of {before} bytes");
}
