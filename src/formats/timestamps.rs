//! Times of sweeps in their file names, as data sets write them.

/// The shortest and the longest time between two sweeps of one flow, seconds.
pub const INTERVAL_S: [f32; 2] = [1e-3, 60.0];

/// The time at which a sweep was recorded, by the timestamp in its file name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SweepTime {
    /// The digits of the timestamp as an integer, in units of `unit`.
    pub ticks: u64,
    /// The unit of `ticks`.
    pub unit: TimeUnit,
}

/// The unit of a timestamp.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TimeUnit {
    /// 1e-9 s, as in Argoverse 2.
    Nanoseconds,
    /// 1e-6 s, as in nuScenes.
    Microseconds,
    /// 1e-3 s.
    Milliseconds,
}

impl TimeUnit {
    /// Nanoseconds of one tick.
    fn nanoseconds(self) -> u64 {
        match self {
            Self::Nanoseconds => 1,
            Self::Microseconds => 1_000,
            Self::Milliseconds => 1_000_000,
        }
    }
}

/// The clock of a sweep whose points have times.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SweepClock {
    /// Time from the first point to the last, seconds.
    pub duration_s: f64,
    /// Time of the sweep on the sensor's clock, seconds, where it is known.
    pub sweep_s: Option<f64>,
}

/// Seconds from the source of a pair to its target, by what is known of them. It is the difference of
/// the timestamps in their `names`, else of the sensor's clock, else the duration of one of the sweeps,
/// because a spinning lidar does not pause between two turns. It is below zero where the target was
/// measured first. None if nothing is known.
pub fn pair_interval_s(names: [&str; 2], clocks: [Option<SweepClock>; 2]) -> Option<f32> {
    let [source, target] = names.map(SweepTime::from_name);
    let by_names = source.zip(target);
    by_names
        .and_then(|(source, target)| source.interval_s(target))
        .or_else(|| {
            let [source, target] = clocks.map(|clock| clock?.sweep_s);
            let apart = source.zip(target).map(|(source, target)| target - source);
            let apart = apart.filter(|seconds| is_interval(seconds.abs()));
            let seconds = apart.or_else(|| Some(clocks[0].or(clocks[1])?.duration_s))?;
            is_interval(seconds.abs()).then_some(seconds as f32)
        })
}

/// Whether a time is within [`INTERVAL_S`].
pub fn is_interval(seconds: f64) -> bool {
    (INTERVAL_S[0]..=INTERVAL_S[1]).contains(&(seconds as f32))
}

/// Time of a sweep, seconds: that in its `name`, else that of its sensor's clock. None if neither is
/// known.
pub fn sweep_time_s(name: &str, clock: Option<SweepClock>) -> Option<f64> {
    let by_name = SweepTime::from_name(name).and_then(SweepTime::seconds);
    by_name.or_else(|| clock?.sweep_s)
}

impl SweepTime {
    /// The time in a file name or path; none if it holds no timestamp.
    ///
    /// A timestamp is a run of digits between the last path separator and the first dot of the file
    /// name. 18 or 19 digits are nanoseconds. 16 are microseconds and 13 milliseconds, unless they
    /// begin with a zero, as a counter does. The last of several timestamps is used. Ten digits, a dot
    /// and nine digits are seconds and nanoseconds, as ROS writes them.
    pub fn from_name(name: &str) -> Option<Self> {
        let file = name.rsplit(['/', '\\']).next()?;
        let mut parts = file.split('.');
        let stem = parts.next()?;
        let is_fraction = |part: &&str| part.len() == 9 && part.bytes().all(|b| b.is_ascii_digit());
        if let Some(fraction) = parts.next().filter(is_fraction) {
            let digits = stem.len() - stem.trim_end_matches(|l: char| l.is_ascii_digit()).len();
            if digits == 10 {
                let ticks = format!("{}{fraction}", &stem[stem.len() - digits..]);
                return Some(Self {
                    ticks: ticks.parse().ok()?,
                    unit: TimeUnit::Nanoseconds,
                });
            }
        }
        let runs = stem.split(|letter: char| !letter.is_ascii_digit());
        let mut found = runs.filter_map(|digits| {
            let unit = match digits.len() {
                18 | 19 => TimeUnit::Nanoseconds,
                16 if !digits.starts_with('0') => TimeUnit::Microseconds,
                13 if !digits.starts_with('0') => TimeUnit::Milliseconds,
                _ => return None,
            };
            let ticks = digits.parse().ok()?;
            Some(Self { ticks, unit })
        });
        found.next_back()
    }

    /// The time in nanoseconds. None if 64 bits do not hold it.
    pub fn nanoseconds(self) -> Option<u64> {
        self.ticks.checked_mul(self.unit.nanoseconds())
    }

    /// The time in seconds. None if 64 bits do not hold its nanoseconds.
    pub fn seconds(self) -> Option<f64> {
        Some(self.nanoseconds()? as f64 * 1e-9)
    }

    /// Seconds from this sweep to another, below zero where the other is the earlier one. None if the
    /// units differ, or the times are less than 1 ms or more than 60 s apart.
    pub fn interval_s(self, other: Self) -> Option<f32> {
        let ticks = self.ticks.abs_diff(other.ticks) as f64;
        let seconds = ticks * self.unit.nanoseconds() as f64 * 1e-9;
        let sign = if other.ticks < self.ticks { -1.0 } else { 1.0 };
        (self.unit == other.unit && is_interval(seconds)).then_some(sign * seconds as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timestamps_of_data_sets_give_the_time_between_their_sweeps() {
        let cases = [
            (
                "a/315966265259836000.feather",
                "a/315966265360032000.feather",
                Some(0.100_196),
            ),
            (
                "n015__LIDAR_TOP__1532402927647951.pcd.bin",
                "n015__LIDAR_TOP__1532402927697731.pcd.bin",
                Some(0.049_78),
            ),
            ("1700000000200.ply", "1700000000100.ply", Some(-0.1)),
            (
                "scan_1617179420.100000000.pcd",
                "scan_1617179420.150000000.pcd",
                Some(0.05),
            ),
            ("1617179420.1.pcd", "1617179420.2.pcd", None),
            ("0000000011.pcd", "0000000012.pcd", None),
            ("0000000000011.pcd", "0000000000012.pcd", None),
            ("1700000000200.ply", "1700000000201.ply", Some(0.001)),
            ("1700000000000000000.ply", "1700000000000000100.ply", None),
            ("1700000000200.ply", "1700000000200.ply", None),
            ("1700000000200.ply", "1800000000200.ply", None),
            ("1700000000200.ply", "315966265259836000.ply", None),
            ("source.ply", "target.ply", None),
        ];
        for (source, target, expected) in cases {
            let [source_time, target_time] = [source, target].map(SweepTime::from_name);
            let found = source_time.zip(target_time);
            let found = found.and_then(|(source, target)| source.interval_s(target));
            let off = found.unwrap_or(-1.0) - expected.unwrap_or(-1.0);
            assert!(off.abs() < 1e-6, "{source}: {found:?}");
        }
    }
}
