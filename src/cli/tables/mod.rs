//! The `tables` command: the methods of the paper side by side on pairs with ground truth.

mod cells;
mod devices;
mod figures;
mod measure;
mod plots;
mod print;
mod rows;
mod run;

pub(super) use run::Tables;
