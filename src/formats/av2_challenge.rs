//! Files of the Argoverse 2 scene flow challenges, one for each pair.
//!
//! | challenge | columns | rows | flow |
//! |---|---|---|---|
//! | 1 | `flow_tx_m`, `flow_ty_m`, `flow_tz_m` float16, `is_dynamic` bool | those of a mask | with the ego motion |
//! | 2 | `is_valid` bool, the flow float16 | all points | without the ego motion |
//! | 3 | the flow float16 | all points | without the ego motion |
//!
//! A point without an estimated flow moves with the ego motion there.

use std::io::Write;

use super::error::{FileKind, FormatError};
use super::feather::{self, FLOW_COLUMNS, Table, Values};
use super::flow_file::FlowTable;
use super::limits::check_flag;
use super::pair::check_count;
use crate::flow::{MotionField, Point, Residual, RigidTransform};

const KIND: FileKind = FileKind::Feather;

/// An edition of the challenge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Av2Challenge {
    /// The first: three-way end-point error.
    One,
    /// The second: bucket-normalized errors.
    Two,
    /// The third: several data sets.
    Three,
}

/// Reads the mask of a sweep of N points: the column `mask`.
///
/// # Errors
/// - `Missing` without that column.
/// - As for a feather cloud, if the bytes are no feather file or a value is no flag.
pub fn read_av2_mask(bytes: &[u8]) -> Result<Vec<bool>, FormatError> {
    let table = Table::open(bytes)?;
    let mask = table.column("mask", |row, value| check_flag(KIND, row, "mask", value))?;
    mask.ok_or_else(|| FormatError::Missing {
        kind: KIND,
        what: "a column mask".to_owned(),
        present: table.names().join(", "),
    })
}

/// Writes the file of one pair. `mask` has a flag for each of N points: the rows that
/// [`Av2Challenge::One`] asks for.
///
/// # Errors
/// - `RowCount` if the mask has another length than the table.
/// - `Encode` if writing fails.
pub fn write_av2_challenge(
    challenge: Av2Challenge,
    table: &FlowTable<'_>,
    mask: Option<&[bool]>,
    out: &mut dyn Write,
) -> Result<(), FormatError> {
    let rows = table.source.len();
    if let Some(mask) = mask {
        check_count("mask", mask.len(), rows)?;
    }
    let asked = |row: &usize| mask.is_none_or(|mask| mask[*row]);
    let still = ego_flow(table.source, table.ego);
    let flow: Vec<Point> = (0..rows)
        .filter(asked)
        .map(|row| {
            let total = match table.valid[row] {
                true => table.flow[row],
                false => still[row],
            };
            let less = match challenge {
                Av2Challenge::One => [0.0; 3],
                Av2Challenge::Two | Av2Challenge::Three => still[row],
            };
            core::array::from_fn(|axis| total[axis] - less[axis])
        })
        .collect();
    let axes = FLOW_COLUMNS.iter().enumerate().map(|(axis, &name)| {
        let values = flow.iter().map(move |row| row[axis]);
        (name, Values::Halves(Box::new(values)))
    });
    let moves = |row| table.dynamic.is_some_and(|dynamic| dynamic[row]);
    let dynamic: Vec<bool> = (0..rows).filter(asked).map(moves).collect();
    let mut columns: Vec<(&str, Values<'_>)> = axes.collect();
    match challenge {
        Av2Challenge::One => columns.push(("is_dynamic", Values::Flags(&dynamic))),
        Av2Challenge::Two => columns.insert(0, ("is_valid", Values::Flags(table.valid))),
        Av2Challenge::Three => {}
    }
    feather::write(out, columns)
}

/// The flow of N static points; zero for points that are not finite, and without an ego motion.
fn ego_flow(source: &[Point], ego: Option<&RigidTransform>) -> Vec<Point> {
    let motion = MotionField {
        ego: ego.copied(),
        residual: Residual::Still,
    };
    let moved = motion.static_positions(source);
    let apart = source.iter().zip(moved).map(|(point, moved)| {
        let flow: Point = core::array::from_fn(|axis| moved[axis] - point[axis]);
        match flow.iter().all(|value| value.is_finite()) {
            true => flow,
            false => [0.0; 3],
        }
    });
    apart.collect()
}
