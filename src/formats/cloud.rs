//! Point clouds in all formats: recognized by content when read, chosen by the caller when written.
//!
//! The order of the rows is kept, because flow is returned in that order.

use std::io::Write;

use super::error::{FileKind, FormatError, shorten};
use super::feather::{Table, Values};
use super::las_read::Las;
use super::limits::{MAX_COORDINATE_M, MAX_POINTS, check_value, check_within};
use super::npz::Npz;
use super::pcd::Pcd;
use super::ply::Ply;
use super::point_times::{PointTimes, TimesColumn};
use super::scalar::{Scalar, write_floats};
use super::sniff::recognize;
use super::timestamps::SweepClock;
use super::{bin, feather, npy, pcd, ply};
use crate::flow::Point;

const AXES: [&str; 3] = ["x", "y", "z"];

/// The points of one sweep, in the order of the file's rows.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cloud {
    /// N x 3: x, y, z in metres. Finite, except for the rows counted by `no_return`.
    pub points: Vec<Point>,
    /// Number of rows that are NaN in x, y and z, PCD's mark for a beam without return. They keep
    /// their row. Only PCD files have them.
    pub no_return: usize,
}

/// The points of one sweep with their times.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TimedCloud {
    /// The points.
    pub cloud: Cloud,
    /// The time of each point. None if the file has none, or the same for all points.
    pub times: Option<PointTimes>,
    /// The clock of the sweep by its finite times, also where the times are not used.
    pub clock: Option<SweepClock>,
    /// Why the file's column of times is not used: a time is NaN or infinite, or they are not those of one
    /// sweep.
    pub refused_times: Option<String>,
}

impl From<Vec<Point>> for Cloud {
    fn from(points: Vec<Point>) -> Self {
        Self {
            points,
            no_return: 0,
        }
    }
}

/// Reads a cloud of any known format. Coordinates are in metres.
///
/// The format is recognized by [`recognize`]: by content, and for raw floats by the file name
/// `name`. An `.npy` array is N x k floats with k at least 3; the first three columns are read. An
/// `.npz` contains one cloud where it has exactly one array named `points`, `xyz` or `pc1`, or none
/// of these and a single array of that shape. A 4 x 4 array counts only if the file has no other.
///
/// ```
/// let ply = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n\
///            property float z\nend_header\n1 2 0.5\n";
/// let cloud = fnsf::formats::read_cloud(ply.as_bytes(), None)?;
/// assert_eq!(cloud.points, [[1.0, 2.0, 0.5]]);
/// # Ok::<(), fnsf::formats::FormatError>(())
/// ```
///
/// # Errors
/// - `Unrecognized` and `Ambiguous` as for [`recognize`]. `Ambiguous` also for an `.npz` with
///   several clouds or with a pair (`pc1` and `pc2`).
/// - `Malformed` for a file that violates its format or is truncated.
/// - `Unsupported` for JSON, integer coordinates, missing values, and arrays, compressions or
///   archives that are not supported.
/// - `Missing` where x, y or z, a PLY file's vertices, or an N x 3 array of an `.npz`, is missing.
/// - `NotFinite` for a coordinate that is NaN or infinite, with row and column. Rows of three NaN
///   are accepted in PCD.
/// - `OutOfRange` for a coordinate over 1e6 m in magnitude, with row and column.
/// - `TooLarge` for more than [`MAX_POINTS`] points, an `.npz` of more than 1,024 members, or a PCD
///   point of more than 64 KiB. Also where the data of an `.npz`, a feather file or a compressed
///   PCD takes more than 4 GiB, or more than 32 MiB plus 32 times the size of the file.
pub fn read_cloud(bytes: &[u8], name: Option<&str>) -> Result<Cloud, FormatError> {
    read_cloud_within(bytes, name, MAX_POINTS)
}

/// As [`read_cloud`], for at most `most` points. A file that declares more is refused before memory
/// is allocated for them.
///
/// # Errors
/// As for [`read_cloud`], and `TooLarge` for more than `most` points.
pub fn read_cloud_within(
    bytes: &[u8],
    name: Option<&str>,
    most: usize,
) -> Result<Cloud, FormatError> {
    read(bytes, name, most, false).map(|(cloud, _)| cloud)
}

/// As [`read_cloud`], with the times of the points, from PLY, PCD, feather and LAS files. A time is the
/// GPS time of LAS, or a field named `offset_ns`, `t`, `time`, `timestamp`, `offset_time` or `time_offset`, in seconds,
/// milliseconds, microseconds or nanoseconds: in one of them the times span a sweep of 0.01 to 1 s.
///
/// # Errors
/// As for [`read_cloud`].
pub fn read_timed_cloud(bytes: &[u8], name: Option<&str>) -> Result<TimedCloud, FormatError> {
    let (cloud, column) = read(bytes, name, MAX_POINTS, true)?;
    let read = TimesColumn::used(column);
    Ok(TimedCloud {
        cloud,
        times: read.times,
        clock: read.clock,
        refused_times: read.refused,
    })
}

/// Reads a cloud and, where `timed`, the column of its points' times.
fn read(
    bytes: &[u8],
    name: Option<&str>,
    most: usize,
    timed: bool,
) -> Result<(Cloud, Option<TimesColumn>), FormatError> {
    let untimed = |points: Vec<Point>| (Cloud::from(points), None);
    match recognize(bytes, name)? {
        FileKind::Npy => npy::read_file(bytes, most).map(untimed),
        FileKind::Npz => read_npz(bytes, most).map(untimed),
        FileKind::Ply => read_ply(bytes, most, timed),
        FileKind::Pcd => read_pcd(bytes, most, timed),
        FileKind::Feather => read_feather(bytes, most, timed),
        kind @ (FileKind::KittiBin | FileKind::NuscenesBin) => {
            bin::read(bytes, kind, most).map(untimed)
        }
        FileKind::Json => Err(FileKind::Json.unsupported("json holds flow here, not clouds")),
        FileKind::Las => read_las(bytes, most, timed),
        kind @ (FileKind::Mcap | FileKind::Hdf5) => {
            Err(kind.unsupported("it has many sweeps; fnsf unpack writes them as files"))
        }
        kind @ (FileKind::Png | FileKind::Camera | FileKind::Poses) => {
            Err(kind.unsupported("no cloud is read from it"))
        }
    }
}

/// The number of rows that a file declares, over all its arrays: a measure of the memory that
/// reading it takes. Nothing but headers is decompressed.
///
/// Raw floats and JSON declare no number. For them the result is the size of the file divided by 12
/// bytes, which for raw floats is an upper bound. The arrays of an `.npz` whose header cannot be
/// read are not counted.
///
/// # Errors
/// - `Unrecognized` and `Ambiguous` as for [`recognize`].
/// - `Malformed`, `Unsupported` and `TooLarge` where the header of the file cannot be read, is not
///   supported, or declares too much.
/// - `Missing` for a PLY file without vertices.
pub fn declared_rows(bytes: &[u8], name: Option<&str>) -> Result<usize, FormatError> {
    match recognize(bytes, name)? {
        FileKind::Npy => npy::declared_rows(bytes),
        FileKind::Npz => {
            let mut npz = Npz::open(bytes)?;
            let rows = npz
                .names()
                .into_iter()
                .filter_map(|name| npz.header(&name).ok());
            Ok(rows.fold(0_usize, |sum, header| sum.saturating_add(header.rows())))
        }
        FileKind::Ply => Ply::open(bytes)?.rows(),
        FileKind::Pcd => Ok(Pcd::open(bytes)?.rows()),
        FileKind::Feather => Ok(Table::open(bytes)?.rows()),
        FileKind::Las => Ok(Las::open(bytes)?.rows()),
        // Raw floats: an upper bound, from the size of a point.
        _ => Ok(bytes.len() / size_of::<Point>()),
    }
}

/// Bytes that decoding a file holds beside its points: the body of a compressed PCD, which is
/// decompressed as a whole. The other formats are decompressed piece by piece.
///
/// # Errors
/// As [`declared_rows`].
pub fn working_bytes(bytes: &[u8], name: Option<&str>) -> Result<u64, FormatError> {
    match recognize(bytes, name)? {
        FileKind::Pcd => Pcd::open(bytes)?.unfolded_bytes(),
        _ => Ok(0),
    }
}

fn read_npz(bytes: &[u8], most: usize) -> Result<Vec<Point>, FormatError> {
    let mut npz = Npz::open_within(bytes, most)?;
    if npz.has("pc1") && npz.has("pc2") {
        return Err(FormatError::Ambiguous(
            "an npz with pc1 and pc2 is a pair, not one cloud".to_owned(),
        ));
    }
    let names = npz.names();
    let mut known: Vec<&str> = ["points", "xyz", "pc1"]
        .into_iter()
        .filter(|name| npz.has(name))
        .collect();
    if known.is_empty() {
        for name in &names {
            let is_cloud = npz.header(name).is_ok_and(|header| {
                header.scalar.is_float() && header.table().is_some_and(|(_, columns)| columns >= 3)
            });
            let is_matrix = npz.header(name).is_ok_and(|header| header.shape == [4, 4]);
            if is_cloud && (!is_matrix || names.len() == 1) {
                known.push(name);
            }
        }
    }
    match known[..] {
        [name] => npz.points(name),
        [] => {
            // The error of an unreadable array is more helpful than that of a missing cloud.
            for name in &names {
                npz.header(name)?;
            }
            let present = npz.described();
            Err(FileKind::Npz.missing("an N x 3 array, such as points", &present))
        }
        _ => Err(FormatError::Ambiguous(format!(
            "the npz has several clouds ({}); keep one, or name it points",
            known
                .iter()
                .map(|name| shorten(name))
                .collect::<Vec<String>>()
                .join(", ")
        ))),
    }
}

fn read_ply(
    bytes: &[u8],
    most: usize,
    timed: bool,
) -> Result<(Cloud, Option<TimesColumn>), FormatError> {
    let kind = FileKind::Ply;
    let ply = Ply::open(bytes)?;
    check_within(kind, ply.rows()?, most)?;
    refuse_integers(kind, |axis| ply.property(axis))?;
    let mut points = Vec::new();
    let mut times = TimesColumn::find(|name| timed && ply.property(name).is_some());
    let wanted = wanted(times.as_ref());
    ply.each(&wanted, |row, values| {
        if points.is_empty() {
            // `each` has checked the declared count against the size of the file before this call.
            points.reserve_exact(ply.rows()?);
        }
        points.push(point(kind, row, values)?);
        if let (Some(times), Some(&time)) = (&mut times, values.get(AXES.len())) {
            times.push(time);
        }
        Ok(())
    })?;
    Ok((Cloud::from(points), times))
}

/// The names of the coordinates, and of the column of times.
fn wanted(times: Option<&TimesColumn>) -> Vec<&'static str> {
    AXES.into_iter()
        .chain(times.map(TimesColumn::name))
        .collect()
}

fn read_pcd(
    bytes: &[u8],
    most: usize,
    timed: bool,
) -> Result<(Cloud, Option<TimesColumn>), FormatError> {
    let kind = FileKind::Pcd;
    let pcd = Pcd::open(bytes)?;
    check_within(kind, pcd.rows(), most)?;
    refuse_integers(kind, |axis| pcd.field(axis))?;
    let mut cloud = Cloud::default();
    let mut times = TimesColumn::find(|name| timed && pcd.field(name).is_some());
    let wanted = wanted(times.as_ref());
    pcd.each(&wanted, |row, values| {
        if cloud.points.is_empty() {
            cloud.points.reserve_exact(pcd.rows());
        }
        let [x, y, z, ..] = *values else {
            return Ok(());
        };
        let returned = ![x, y, z].iter().all(|value| value.is_nan());
        if returned {
            cloud.points.push(point(kind, row, values)?);
        } else {
            cloud.no_return += 1;
            cloud.points.push([f32::NAN; 3]);
        }
        if let (Some(times), Some(&time)) = (&mut times, values.get(AXES.len())) {
            match returned {
                true => times.push(time),
                false => times.push_no_return(),
            }
        }
        Ok(())
    })?;
    Ok((cloud, times))
}

fn read_feather(
    bytes: &[u8],
    most: usize,
    timed: bool,
) -> Result<(Cloud, Option<TimesColumn>), FormatError> {
    let kind = FileKind::Feather;
    let table = Table::open(bytes)?;
    check_within(kind, table.rows(), most)?;
    let points = read_columns(&table, AXES)?;
    let mut times = TimesColumn::find(|name| timed && table.has(name));
    if let Some(times) = &mut times {
        table.each(times.name(), |_, time| {
            times.push(time);
            Ok(())
        })?;
    }
    Ok((Cloud::from(points), times))
}

fn read_las(
    bytes: &[u8],
    most: usize,
    timed: bool,
) -> Result<(Cloud, Option<TimesColumn>), FormatError> {
    let kind = FileKind::Las;
    let las = Las::open(bytes)?;
    check_within(kind, las.rows(), most)?;
    let mut points = Vec::with_capacity(las.rows());
    let mut times = TimesColumn::find(|name| timed && las.has_times() && name == "timestamp");
    las.each(|row, [x, y, z, time]| {
        points.push(point(kind, row, &[x, y, z])?);
        if let Some(times) = &mut times {
            times.push(time);
        }
        Ok(())
    })?;
    Ok((Cloud::from(points), times))
}

/// Three float columns of a feather table as N points or displacements, in metres.
pub(super) fn read_columns(table: &Table<'_>, names: [&str; 3]) -> Result<Vec<Point>, FormatError> {
    let kind = FileKind::Feather;
    for name in names {
        if table.has(name) && !table.is_float(name) {
            return Err(kind.unsupported(format!("column {name} is not of floats")));
        }
    }
    let mut points = Vec::new();
    for (axis, name) in names.into_iter().enumerate() {
        table.each(name, |row, value| {
            if points.is_empty() {
                points = vec![[0.0; 3]; table.rows()];
            }
            let points: &mut Vec<Point> = &mut points;
            points[row][axis] = check_value(kind, row, name, value)?;
            Ok(())
        })?;
    }
    Ok(points)
}

/// Refuses integer coordinates, whose unit is unknown: centimetres, millimetres and scaled
/// coordinates all exist.
fn refuse_integers(
    kind: FileKind,
    scalar_of: impl Fn(&str) -> Option<Scalar>,
) -> Result<(), FormatError> {
    for axis in AXES {
        if scalar_of(axis).is_some_and(|scalar| !scalar.is_float()) {
            return Err(
                kind.unsupported(format!("{axis} is an integer; metres as floats are read"))
            );
        }
    }
    Ok(())
}

fn point(kind: FileKind, row: usize, values: &[f64]) -> Result<Point, FormatError> {
    let mut point = [0.0; 3];
    for ((coordinate, &value), axis) in point.iter_mut().zip(values).zip(AXES) {
        *coordinate = if value.abs() <= MAX_COORDINATE_M {
            value as f32
        } else {
            check_value(kind, row, axis, value)?
        };
    }
    Ok(point)
}

/// The formats in which a cloud can be written. Coordinates are in metres.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum CloudFormat {
    /// N x 3 float32.
    Npy,
    /// Binary little endian, x y z float.
    Ply,
    /// Binary, x y z float32. The only format with rows without return.
    Pcd,
    /// Columns x, y, z, float32, LZ4-compressed.
    Feather,
    /// KITTI's rows of four float32, intensity 0.
    KittiBin,
}

/// Writes a sweep as PCD: N points, metres, and N times, seconds, in the field `time`.
///
/// # Errors
/// As for [`write_cloud`].
pub fn write_timed_pcd(
    points: &[Point],
    times: &[f32],
    out: &mut dyn Write,
) -> Result<(), FormatError> {
    check_points(FileKind::Pcd, points)?;
    let fields = ["x", "y", "z", "time"].map(|name| (name, 4, 'F'));
    pcd::write_header(out, points.len(), &fields)?;
    let rows = points.iter().zip(times);
    let rows: Vec<[f32; 4]> = rows.map(|(&[x, y, z], &time)| [x, y, z, time]).collect();
    write_floats(out, rows.as_flattened())
}

/// Writes a cloud of N points, metres.
///
/// # Errors
/// - `NotFinite` for a coordinate that is NaN or infinite. Rows of three NaN (no return) are
///   accepted in PCD.
/// - `OutOfRange` for a coordinate over 1e6 m in magnitude.
/// - `Write` where writing to `out` fails. For feather this is `Encode`, as is a failure to encode.
pub fn write_cloud(
    format: CloudFormat,
    points: &[Point],
    out: &mut dyn Write,
) -> Result<(), FormatError> {
    let kind = match format {
        CloudFormat::Npy => FileKind::Npy,
        CloudFormat::Ply => FileKind::Ply,
        CloudFormat::Pcd => FileKind::Pcd,
        CloudFormat::Feather => FileKind::Feather,
        CloudFormat::KittiBin => FileKind::KittiBin,
    };
    check_points(kind, points)?;
    match format {
        CloudFormat::Npy => npy::write_points(out, points),
        CloudFormat::Ply => {
            let properties = AXES.map(|axis| ("float", axis));
            ply::write_header(out, points.len(), &[], &properties)?;
            write_floats(out, points.as_flattened())
        }
        CloudFormat::Pcd => {
            pcd::write_header(out, points.len(), &AXES.map(|axis| (axis, 4, 'F')))?;
            write_floats(out, points.as_flattened())
        }
        CloudFormat::Feather => {
            let column = |axis: usize| -> Values<'_> {
                Values::Floats(Box::new(points.iter().map(move |point| point[axis])))
            };
            feather::write(
                out,
                vec![("x", column(0)), ("y", column(1)), ("z", column(2))],
            )
        }
        CloudFormat::KittiBin => bin::write_kitti(out, points),
    }
}

/// Refuses coordinates that no reader accepts.
fn check_points(kind: FileKind, points: &[Point]) -> Result<(), FormatError> {
    let no_return =
        |point: &Point| kind == FileKind::Pcd && point.iter().all(|value| value.is_nan());
    for (row, values) in points
        .iter()
        .enumerate()
        .filter(|(_, values)| !no_return(values))
    {
        point(kind, row, &values.map(f64::from))?;
    }
    Ok(())
}
