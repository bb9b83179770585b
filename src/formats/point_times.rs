//! Times of the points of one sweep, in the units and from the origins that drivers write.

use super::timestamps::SweepClock;

/// Names of a column of point times, the first that is there is read. `offset_ns` is Argoverse 2's,
/// `t` is Ouster's, `time` Velodyne's, `timestamp` Hesai's, Robosense's and Livox's.
const NAMES: [&str; 6] = [
    "offset_ns",
    "t",
    "time",
    "timestamp",
    "offset_time",
    "time_offset",
];
/// Seconds in a unit of time: second, millisecond, microsecond, nanosecond.
const UNITS_S: [f64; 4] = [1.0, 1e-3, 1e-6, 1e-9];
/// Shortest and longest duration of a sweep, seconds. The ranges that they span in the four units
/// have no value in common, so that a duration determines its unit.
const SWEEP_S: [f64; 2] = [0.01, 1.0];

/// Times of the N points of one sweep.
#[derive(Clone, Debug, PartialEq)]
pub struct PointTimes {
    /// N times, seconds after the time of the sweep; negative before it. Zero for rows without
    /// return.
    pub offsets_s: Vec<f32>,
    /// Time from the first point to the last, seconds.
    pub duration_s: f64,
    /// Time of the sweep on the sensor's clock, seconds, if the file has it.
    pub sweep_s: Option<f64>,
}

impl PointTimes {
    /// The clock of the sweep.
    pub fn clock(&self) -> SweepClock {
        SweepClock {
            duration_s: self.duration_s,
            sweep_s: self.sweep_s,
        }
    }
}

/// What is known of a sweep by its column of point times.
#[derive(Default)]
pub(super) struct ReadTimes {
    pub(super) times: Option<PointTimes>,
    /// The clock of the sweep by its finite times, also where the times are not used.
    pub(super) clock: Option<SweepClock>,
    /// Why they are not used.
    pub(super) refused: Option<String>,
}

/// The values of a column of point times, one for each row read so far.
pub(super) struct TimesColumn {
    name: &'static str,
    values: Vec<f64>,
    /// The first row with a return whose time is NaN or infinite.
    not_finite: Option<usize>,
}

impl TimesColumn {
    /// The column of point times among those for which `has` holds.
    pub(super) fn find(has: impl Fn(&str) -> bool) -> Option<Self> {
        let name = NAMES.into_iter().find(|name| has(name))?;
        Some(Self::named(name))
    }

    /// A column of another name, which the format determines.
    pub(super) fn named(name: &'static str) -> Self {
        Self {
            name,
            values: Vec::new(),
            not_finite: None,
        }
    }

    /// The name of the column.
    pub(super) fn name(&self) -> &'static str {
        self.name
    }

    /// Adds the time of the next row.
    pub(super) fn push(&mut self, time: f64) {
        if !time.is_finite() {
            self.not_finite.get_or_insert(self.values.len());
        }
        self.values.push(time);
    }

    /// Adds a row without return.
    pub(super) fn push_no_return(&mut self) {
        self.values.push(f64::NAN);
    }

    /// What is known by a column that a file may have.
    pub(super) fn used(column: Option<Self>) -> ReadTimes {
        let Some(column) = column else {
            return ReadTimes::default();
        };
        let (times, refused) = match column.times() {
            Ok(times) => (times, None),
            Err(refused) => (None, Some(refused)),
        };
        let clock = times.as_ref().map(PointTimes::clock);
        let broken = column.not_finite.map(|row| {
            format!(
                "its column {} is NaN or infinite in row {row}: the points count as measured at one instant",
                column.name
            )
        });
        ReadTimes {
            times: times.filter(|_| broken.is_none()),
            clock,
            refused: broken.or(refused),
        }
    }

    /// The times; an explanation where they are not those of one sweep. None where all points have
    /// the same time.
    ///
    /// The duration determines the unit. The time of the sweep is the origin of the column if that is
    /// at most two durations away from the points, otherwise the first point's.
    fn times(&self) -> Result<Option<PointTimes>, String> {
        let finite = || {
            self.values
                .iter()
                .copied()
                .filter(|value| value.is_finite())
        };
        let first = finite().fold(f64::INFINITY, f64::min);
        let last = finite().fold(f64::NEG_INFINITY, f64::max);
        let span = last - first;
        if span <= 0.0 || !span.is_finite() {
            return Ok(None);
        }
        let [least, most] = SWEEP_S;
        let unit = UNITS_S
            .into_iter()
            .find(|unit| (least..most).contains(&(span * unit)));
        let unit = unit.ok_or_else(|| {
            format!(
                "its column {} spans {span:.3e}, which in no unit is a sweep of {least} to {most} s: \
                 the points count as measured at one instant",
                self.name
            )
        })?;
        let is_relative = first.abs().max(last.abs()) <= 2.0 * span;
        let origin = if is_relative { 0.0 } else { first };
        let offset = |&value: &f64| match value.is_finite() {
            true => ((value - origin) * unit) as f32,
            false => 0.0,
        };
        Ok(Some(PointTimes {
            offsets_s: self.values.iter().map(offset).collect(),
            duration_s: span * unit,
            sweep_s: (!is_relative).then_some(first * unit),
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn times(name: &str, values: &[f64]) -> Result<Option<PointTimes>, String> {
        let mut column = TimesColumn::find(|known| known == name).expect("a column");
        column.values.extend(values);
        column.times()
    }

    #[test]
    fn the_duration_of_a_sweep_determines_the_unit_of_its_times() {
        for (name, values, offsets, sweep_s) in [
            (
                "offset_ns",
                [2_500_000.0, 105_000_000.0],
                [0.0025, 0.105],
                None,
            ),
            ("t", [0.0, 99_900_000.0], [0.0, 0.0999], None),
            ("time", [-0.1, 0.0], [-0.1, 0.0], None),
            ("offset_time", [0.0, 50_000.0], [0.0, 0.05], None),
            (
                "timestamp",
                [1.6e9, 1.6e9 + 0.125],
                [0.0, 0.125],
                Some(1.6e9),
            ),
            (
                "timestamp",
                [1.6e18, 1.6e18 + 125e6],
                [0.0, 0.125],
                Some(1.6e9),
            ),
            ("timestamp", [100.0, 150.0], [0.0, 0.05], Some(0.1)),
        ] {
            let found = times(name, &values).expect("one sweep").expect("times");
            for (found, expected) in found.offsets_s.iter().zip(offsets) {
                assert!((found - expected).abs() < 1e-6, "{name}: {found}");
            }
            match (found.sweep_s, sweep_s) {
                (None, None) => {}
                (Some(found), Some(expected)) => assert!((found - expected).abs() < 1e-3),
                (found, expected) => panic!("{name}: {found:?}, not {expected:?}"),
            }
        }
    }

    #[test]
    fn one_time_for_all_points_is_none_and_a_day_of_points_is_no_sweep() {
        assert_eq!(times("time", &[5.0, 5.0]), Ok(None));
        assert_eq!(times("time", &[f64::NAN, f64::NAN]), Ok(None));
        let refused = times("time", &[0.0, 86_400.0 * 1e12]).expect_err("a day of picoseconds");
        assert!(refused.contains("column time spans 8.640e16"), "{refused}");
    }

    #[test]
    fn a_time_that_is_not_finite_costs_the_sweep_its_times_but_not_its_clock() {
        let mut column = TimesColumn::named("time");
        for time in [7.0, f64::NAN, 7.1] {
            column.push(time);
        }
        let read = TimesColumn::used(Some(column));
        let clock = read.clock.expect("of the finite times");
        assert!((clock.duration_s - 0.1).abs() < 1e-9 && clock.sweep_s == Some(7.0));
        let refused = read.refused.expect("a reason");
        assert!(refused.contains("infinite in row 1"), "{refused}");
        assert_eq!(read.times, None);
    }

    #[test]
    fn rows_without_return_are_measured_at_the_sweeps_time() {
        let found = times("time", &[0.0, f64::NAN, 0.1])
            .expect("one sweep")
            .expect("times");
        assert_eq!(found.offsets_s, [0.0, 0.0, 0.1]);
    }
}
