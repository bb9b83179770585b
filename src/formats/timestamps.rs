//! Times of sweeps in their file names, as data sets write them.

/// The longest time between two sweeps of one flow, seconds.
const MAX_INTERVAL_S: f64 = 60.0;

/// The time from one sweep to the other, seconds, by the timestamps in their file names: the
/// distance of both in either order. None where a name holds no timestamp, or both are the same or
/// more than a minute apart.
///
/// A timestamp is a run of digits in the name without its folder and ending: 18 or 19 digits are
/// nanoseconds (Argoverse 2), 16 microseconds (nuScenes), 13 milliseconds.
pub fn interval_s(source: &str, target: &str) -> Option<f32> {
    let (source, unit) = timestamp(source)?;
    let (target, other) = timestamp(target)?;
    let seconds = source.abs_diff(target) as f64 * unit;
    (unit == other && seconds > 0.0 && seconds <= MAX_INTERVAL_S).then_some(seconds as f32)
}

/// The timestamp of a name, and its unit, seconds.
fn timestamp(name: &str) -> Option<(u64, f64)> {
    let file = name.rsplit(['/', '\\']).next()?;
    let stem = file.split('.').next()?;
    let runs = stem.split(|letter: char| !letter.is_ascii_digit());
    let mut found = runs.filter_map(|digits| {
        let unit = match digits.len() {
            18 | 19 => 1e-9,
            16 => 1e-6,
            13 => 1e-3,
            _ => return None,
        };
        Some((digits.parse().ok()?, unit))
    });
    found.next_back()
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
            ("1700000000200.ply", "1700000000100.ply", Some(0.1)),
            ("0000000011.pcd", "0000000012.pcd", None),
            ("1700000000200.ply", "1700000000200.ply", None),
            ("1700000000200.ply", "1800000000200.ply", None),
            ("1700000000200.ply", "315966265259836000.ply", None),
            ("source.ply", "target.ply", None),
        ];
        for (source, target, expected) in cases {
            let found = interval_s(source, target);
            let off = found.unwrap_or(-1.0) - expected.unwrap_or(-1.0);
            assert!(off.abs() < 1e-6, "{source}: {found:?}");
        }
    }
}
