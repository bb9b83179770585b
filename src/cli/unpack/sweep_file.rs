//! The files of sweeps, and the names of their folders.

use std::path::Path;

use crate::cli::failure::Failure;
use crate::cli::files;
use crate::flow::Point;
use crate::formats::{CloudFormat, PointTimes, write_cloud, write_timed_pcd};

/// Writes a sweep below the folder `output`, with the times of its points where they are known.
pub(super) fn write_sweep(
    output: &Path,
    name: &Path,
    points: &[Point],
    times: Option<&PointTimes>,
) -> Result<(), Failure> {
    files::write_below(output, name, |file| match times {
        None => write_cloud(CloudFormat::Pcd, points, file),
        Some(times) => write_timed_pcd(points, &times.offsets_s, file),
    })
}

/// The folder of a topic or a scene: its name with `_` for everything but letters, digits and `-`.
pub(super) fn folder_of(name: &str) -> String {
    let plain = |letter: char| match letter {
        letter if letter.is_ascii_alphanumeric() || letter == '-' => letter,
        _ => '_',
    };
    let name: String = name
        .trim_matches('/')
        .chars()
        .take(100)
        .map(plain)
        .collect();
    match name.is_empty() {
        true => "clouds".to_owned(),
        false => name,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_folder_of_a_topic_is_a_plain_name() {
        assert_eq!(folder_of("/lidar/top/points"), "lidar_top_points");
        assert_eq!(folder_of("/../a b"), "___a_b");
        assert_eq!(folder_of("/"), "clouds");
    }
}
