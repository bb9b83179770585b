//! Argoverse 2: `annotations.feather`, a row for each box of each sweep, in the frame of its sweep.

use super::layout_file::LayoutFile;
use super::sequence::BoxSequence;
use crate::formats::error::{FileKind, FormatError};
use crate::formats::feather::{Values, write};
use crate::formats::timestamps::SweepTime;

/// Nanoseconds of a sweep, from its name.
fn stamp_ns(name: &str) -> Result<i64, FormatError> {
    let stamp = SweepTime::from_name(name).and_then(SweepTime::nanoseconds);
    let stamp = stamp.and_then(|stamp| i64::try_from(stamp).ok());
    stamp.ok_or_else(|| {
        FileKind::Feather.unsupported(format!(
            "annotations of Argoverse 2 have the times of sweeps, and the name {name} has none: name \
             sweeps by their nanoseconds"
        ))
    })
}

/// The annotations of all sweeps.
///
/// # Errors
/// `Unsupported` for a name without a time, and [`FormatError::Write`] if arrow fails.
pub(super) fn file(sequence: &BoxSequence<'_>) -> Result<LayoutFile, FormatError> {
    let mut stamps = Vec::new();
    let (mut keys, mut classes, mut counts) = (Vec::new(), Vec::new(), Vec::new());
    // Length, width, height, the quaternion w, x, y, z, and the center.
    let mut values: [Vec<f64>; 10] = Default::default();
    for (name, boxes) in sequence.by_sweep() {
        let stamp = stamp_ns(name)?;
        for (track, state) in boxes {
            let bounds = &state.bounds;
            let [length, width, height] = bounds.size.map(f64::from);
            let [x, y, z] = bounds.center.map(f64::from);
            let (sine, cosine) = (f64::from(bounds.yaw) / 2.0).sin_cos();
            let row = [length, width, height, cosine, 0.0, 0.0, sine, x, y, z];
            for (column, value) in values.iter_mut().zip(row) {
                column.push(value);
            }
            stamps.push(stamp);
            keys.push(sequence.key(&format!("object {}", track.id)).to_string());
            classes.push(sequence.class.to_owned());
            counts.push(i64::from(state.points));
        }
    }
    let names = [
        "length_m", "width_m", "height_m", "qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m",
    ];
    let mut columns = vec![
        ("timestamp_ns", Values::Integers(&stamps)),
        ("track_uuid", Values::Texts(&keys)),
        ("category", Values::Texts(&classes)),
    ];
    let values = names.into_iter().zip(&values);
    columns.extend(values.map(|(name, values)| (name, Values::Doubles(values))));
    columns.push(("num_interior_pts", Values::Integers(&counts)));
    let mut bytes = Vec::new();
    write(&mut bytes, columns)?;
    Ok(LayoutFile {
        path: "annotations.feather".to_owned(),
        bytes,
    })
}

#[cfg(test)]
mod tests {
    use super::super::samples::{names, tracks};
    use super::*;
    use crate::formats::feather::Table;

    #[test]
    fn a_row_has_the_time_of_its_sweep_in_nanoseconds_whatever_the_unit_of_the_name() {
        for (name, stamp) in [
            ("315966265259836000", 315_966_265_259_836_000),
            ("1532402927647951", 1_532_402_927_647_951_000),
            ("lidar-1532402927647", 1_532_402_927_647_000_000),
        ] {
            assert_eq!(stamp_ns(name).expect("a time"), stamp);
        }
    }

    #[test]
    fn the_columns_are_those_of_the_data_set() {
        let tracks = tracks();
        let names: Vec<String> = (0..3).map(|n| format!("31596626525983600{n}")).collect();
        let sequence = BoxSequence::new(&tracks, &names, "REGULAR_VEHICLE").expect("a sequence");
        let file = file(&sequence).expect("a file");
        let table = Table::open(&file.bytes).expect("a table");
        assert_eq!(table.rows(), 4);
    }

    #[test]
    fn sweeps_without_times_are_refused_with_what_to_do() {
        let (tracks, names) = (tracks(), names());
        let sequence = BoxSequence::new(&tracks, &names, "mover").expect("a sequence");
        let refused = file(&sequence).expect_err("no times").to_string();
        assert!(refused.contains("by their nanoseconds"), "{refused}");
    }
}
