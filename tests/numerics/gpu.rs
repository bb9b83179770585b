//! Tests of a GPU on real pairs, compared with the CPU. They need a GPU; a software one suffices.

use fnsf::flow::cpu::{CpuBackend, Isa};
use fnsf::flow::field::Backend;
use fnsf::flow::gpu::{AdapterKind, Gpu, GpuOptions, adapters};
use fnsf::flow::{Preset, Problem, Uncontrolled, estimate};

use super::gpu_rule;
use super::scenes::{estimated_on, real_pair, scored};

#[test]
fn a_card_gives_the_cpus_flow_on_argoverse_2_bit_by_bit() {
    let Some(pair) = real_pair("av2_7fab") else {
        return;
    };
    let cards = adapters();
    if !gpu_rule::is_there(cards.len()) {
        return;
    }
    let gpu = Gpu::open(&cards[0], &GpuOptions::default()).expect("the card opens");
    // A software GPU is slow: a bit that differs does so from its iteration on.
    let mut options = Preset::Neural.options(Some(2048));
    options.field_mut().expect("a field").max_iterations = 30;
    options.crop_m = Some(51.2);
    let card = estimated_on(&gpu, &pair, &options);
    // Some GPUs round a product before the addition, as the portable kernels do. Others use fused
    // multiply-add, as the other kernels do.
    let cpus = Isa::available().into_iter().map(|isa| {
        let cpu = CpuBackend::with_isa(isa, Some(2)).expect("threads");
        estimated_on(&cpu, &pair, &options)
    });
    let cpus: Vec<_> = cpus.collect();
    let errors: Vec<_> = cpus.iter().map(|cpu| scored(&pair, cpu).epe).collect();
    let same = cpus.iter().any(|cpu| cpu.flow == card.flow);
    assert!(same, "{} {errors:?}", scored(&pair, &card).epe);
    options.field_mut().expect("a field").max_iterations = 10;
    let [first, second] = [(), ()].map(|()| estimated_on(&gpu, &pair, &options).flow);
    assert!(first == second);
}

#[test]
fn a_card_finds_the_cpus_objects_in_whole_real_sweeps() {
    /// Least share of points whose flows have the same bits. Static points have those of the ego
    /// motion. Sines, cosines and sums of a GPU round differently.
    const SAME: f64 = 0.98;
    let names = ["av2_7fab", "kitti_0000", "small_gicp"];
    let Some(pairs) = names.map(real_pair).into_iter().collect::<Option<Vec<_>>>() else {
        return;
    };
    let cards = adapters();
    if !gpu_rule::is_there(cards.len()) {
        return;
    }
    let options = GpuOptions {
        cluster_threads: Some(usize::MAX),
        ..GpuOptions::default()
    };
    let gpu = Gpu::open(&cards[0], &options).expect("the card opens");
    let cpu = CpuBackend::new(Some(2)).expect("threads");
    // Largest difference of two flows, metres.
    let alike_m = match cards[0].kind {
        AdapterKind::Software => 1e-4,
        _ => 0.02,
    };
    for (name, pair) in names.iter().zip(&pairs) {
        let problem = Problem::pair(&pair.source, &pair.target);
        let options = Preset::Default.options(None);
        let [card, host] = [&gpu as &dyn Backend, &cpu]
            .map(|backend| estimate(backend, &problem, &options, &Uncontrolled).expect("a flow"));
        assert_eq!(card.device, gpu.name());
        let [on_card, on_host] =
            [&card, &host].map(|found| found.object_search().expect("objects"));
        assert!(on_card.searched > 100, "{name}");
        assert_eq!(on_card.searched, on_host.searched, "{name}");
        assert_eq!(on_card.objects.cluster, on_host.objects.cluster, "{name}");
        assert_eq!(card.valid, host.valid, "{name}");
        let away = card.flow.iter().flatten().zip(host.flow.iter().flatten());
        let unlike = away.filter(|(a, b)| (*a - *b).abs() >= alike_m || a.is_nan() != b.is_nan());
        assert_eq!(unlike.count(), 0, "{name}");
        let same = card.flow.iter().zip(&host.flow).filter(|(a, b)| a == b);
        let share = same.count() as f64 / host.flow.len() as f64;
        assert!(share > SAME, "{name}: {share}");
    }
}
