//! A card on a real pair, beside the CPU. Needs a card; a software one will do.

use fnsf::flow::Preset;
use fnsf::flow::cpu::{CpuBackend, Isa};
use fnsf::flow::gpu::{Gpu, GpuOptions, adapters};

use super::gpu_rule;
use super::scenes::{real_pair, scored, solve_on};

#[test]
fn a_card_gives_the_cpus_error_on_argoverse_2_and_twice_the_same_bits() {
    // Beyond what rounding makes of the CPU's own instruction sets for this seed, metres.
    const DIFFERENCE_M: f64 = 0.002;
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
    let ours = scored(&pair, &card).epe;
    let cpus = Isa::available().into_iter().map(|isa| {
        let cpu = CpuBackend::with_isa(isa, Some(2)).expect("threads");
        scored(&pair, &solve_on(&cpu, &pair, &options)).epe
    });
    let cpus: Vec<f64> = cpus.collect();
    let least = cpus.iter().copied().fold(f64::INFINITY, f64::min);
    let most = cpus.iter().copied().fold(0.0, f64::max);
    let near = least - DIFFERENCE_M..most + DIFFERENCE_M;
    assert!(near.contains(&ours), "{ours} {cpus:?}");
    // The bits are asked for on fewer points: a software card takes its time.
    let mut fewer = Preset::Neural.options(Some(1024));
    fewer.max_iterations = 40;
    let [first, second] = [(), ()].map(|()| solve_on(&gpu, &pair, &fewer).flow);
    assert!(first == second);
}
