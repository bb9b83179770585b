//! A card on a real pair, beside the CPU. Needs a card; a software one will do.

use fnsf::flow::Preset;
use fnsf::flow::gpu::{Gpu, GpuOptions, adapters};

use super::gpu_rule;
use super::scenes::{real_pair, scored, solve, solve_on};

#[test]
fn a_card_gives_the_cpus_error_on_argoverse_2_and_twice_the_same_bits() {
    const DIFFERENCE_M: f64 = 0.002;
    let Some(pair) = real_pair("av2_7fab") else {
        return;
    };
    let cards = adapters();
    if !gpu_rule::is_there(cards.len()) {
        return;
    }
    let gpu = Gpu::open(&cards[0], &GpuOptions::default()).expect("the card opens");
    let mut options = Preset::Default.options(Some(8192));
    options.range_m = Some(51.2);
    let card = solve_on(&gpu, &pair, &options);
    let [ours, cpus] = [&card, &solve(&pair, &options)].map(|flow| scored(&pair, flow).epe);
    assert!((ours - cpus).abs() < DIFFERENCE_M, "{ours} {cpus}");
    // The bits are asked for on fewer points: a software card takes its time.
    let mut fewer = Preset::Default.options(Some(1024));
    fewer.max_iterations = 40;
    let [first, second] = [(), ()].map(|()| solve_on(&gpu, &pair, &fewer).flow);
    assert!(first == second);
}
