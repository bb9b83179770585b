//! A card on a real pair, beside the CPU. Needs a card; a software one will do.

use fnsf::flow::Preset;
use fnsf::flow::cpu::{CpuBackend, Isa};
use fnsf::flow::gpu::{Gpu, GpuOptions, adapters};

use super::gpu_rule;
use super::scenes::{real_pair, scored, solve_on};

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
    let mut options = Preset::Neural.options(Some(8192));
    options.range_m = Some(51.2);
    let card = solve_on(&gpu, &pair, &options);
    // Some cards round a product before they add to it, as the portable kernels do, others do not,
    // as the others do.
    let cpus = Isa::available().into_iter().map(|isa| {
        let cpu = CpuBackend::with_isa(isa, Some(2)).expect("threads");
        solve_on(&cpu, &pair, &options)
    });
    let cpus: Vec<_> = cpus.collect();
    let errors: Vec<_> = cpus.iter().map(|cpu| scored(&pair, cpu).epe).collect();
    let same = cpus.iter().any(|cpu| cpu.flow == card.flow);
    assert!(same, "{} {errors:?}", scored(&pair, &card).epe);
    // Twice the same bits, on fewer points: a software card takes its time.
    let mut fewer = Preset::Neural.options(Some(1024));
    fewer.max_iterations = 40;
    let [first, second] = [(), ()].map(|()| solve_on(&gpu, &pair, &fewer).flow);
    assert!(first == second);
}
