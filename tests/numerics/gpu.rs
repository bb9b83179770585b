//! Tests of a GPU on a real pair, compared with the CPU. They need a GPU; a software one suffices.

use fnsf::flow::Preset;
use fnsf::flow::cpu::{CpuBackend, Isa};
use fnsf::flow::gpu::{Gpu, GpuOptions, adapters};

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
