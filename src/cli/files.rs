//! Reading and writing of files, with errors that name the file.

use std::collections::{HashMap, HashSet};
use std::fs::{self, File};
use std::io::{BufWriter, Read, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use rustix::fs::{Access, access};

use super::failure::Failure;
use super::laz;
use super::output::complain;
use super::unfinished::Unfinished;
use crate::flow::depth::Camera;
use crate::flow::tracks::Track;
use crate::flow::{Point, RigidTransform};
use crate::formats;
use crate::formats::{
    FileKind, FlowFile, FormatError, GroundRaster, KittiCamera, NUSCENES_TABLES, NuscenesScene,
    Pair, PairTruth, TimedCloud,
};

/// The largest file that is read, bytes.
const MAX_FILE: u64 = 4 << 30;

/// Whether a file that is to be written lies directly in a folder.
pub(super) fn is_in(path: &Path, folder: &Path) -> bool {
    let folder = fs::canonicalize(folder).ok();
    place_of(path).is_some_and(|path| path.parent() == folder.as_deref())
}

/// Reads a whole file of at most 4 GiB.
pub(super) fn read_bytes(path: &Path) -> Result<Vec<u8>, Failure> {
    let read = || -> anyhow::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        let file = File::open(path)?;
        if file.metadata()?.len() > MAX_FILE {
            return Err(anyhow!("more than {MAX_FILE} bytes"));
        }
        file.take(MAX_FILE + 1).read_to_end(&mut bytes)?;
        if bytes.len() as u64 > MAX_FILE {
            return Err(anyhow!("more than {MAX_FILE} bytes"));
        }
        Ok(bytes)
    };
    read()
        .with_context(|| format!("cannot read {}", path.display()))
        .map_err(Failure::bad_input)
}

/// Reads a file, unpacks LAZ, and passes its bytes and name to `reader`.
fn read<T>(
    path: &Path,
    reader: impl FnOnce(&[u8], Option<&str>) -> Result<T, FormatError>,
) -> Result<T, Failure> {
    let name = path.file_name().map(|name| name.to_string_lossy());
    laz::unpacked(read_bytes(path)?)
        .and_then(|bytes| Ok(reader(&bytes, name.as_deref())?))
        .with_context(|| path.display().to_string())
        .map_err(Failure::bad_input)
}

/// Reads one sweep, in any format.
pub(super) fn read_cloud(path: &Path) -> Result<Vec<Point>, Failure> {
    read(path, formats::read_cloud).map(|cloud| cloud.points)
}

/// Reads the intensities of the `points` points of a sweep. None where its file has none.
pub(super) fn read_intensity(path: &Path, points: usize) -> Result<Option<Vec<f32>>, Failure> {
    read(path, |bytes, name| {
        let found = formats::read_intensity(bytes, name)?;
        match found.as_ref().map(Vec::len) {
            Some(found) if found != points => Err(FormatError::RowCount {
                what: "intensity".to_owned(),
                found,
                expected: points,
            }),
            _ => Ok(found),
        }
    })
}

/// Reads the poses `world_from_frame` of the sweeps at `paths`.
pub(super) fn read_poses(file: &Path, paths: &[PathBuf]) -> Result<Vec<RigidTransform>, Failure> {
    let names = paths.iter();
    let names = names.map(|path| path.file_name().unwrap_or_default().to_string_lossy());
    let names: Vec<_> = names.collect();
    let names: Vec<&str> = names.iter().map(AsRef::as_ref).collect();
    let poses = formats::read_poses(&read_bytes(file)?, &names);
    poses
        .with_context(|| file.display().to_string())
        .map_err(Failure::bad_input)
}

/// Reads one sweep with the times of its points, in any format.
pub(super) fn read_timed_cloud(path: &Path) -> Result<TimedCloud, Failure> {
    read(path, formats::read_timed_cloud)
}

/// Warns that the points of sweeps have times, where `what`, such as tracks, may be those of deskewed sweeps.
pub(super) fn warn_of_times(what: &str) {
    complain(format_args!(
        "warning: the points of these sweeps have times. If the {what} are those of deskewed sweeps, they lie beside \
         the points at high speed: fnsf label --ignore-times and fnsf flow --deskew off make {what} that fit"
    ));
}

/// Reads a pair of sweeps from one `.npz`.
pub(super) fn read_pair(path: &Path) -> Result<Pair, Failure> {
    let bytes = read_bytes(path)?;
    let name = path.file_name().map(|name| name.to_string_lossy());
    let pair = if formats::is_pair(&bytes) {
        formats::read_pair(&bytes)
    } else {
        match formats::read_cloud(&bytes, name.as_deref()) {
            Ok(_) => {
                let message = format!("{} is one cloud: give the target too", path.display());
                return Err(Failure::usage(anyhow!(message)));
            }
            Err(error) => Err(error),
        }
    };
    pair.with_context(|| path.display().to_string())
        .map_err(Failure::bad_input)
}

/// Reads a flow, in any format.
pub(super) fn read_flow(path: &Path) -> Result<FlowFile, Failure> {
    read(path, formats::read_flow)
}

/// Whether a file has tracks.
pub(super) fn is_tracks(path: &Path) -> Result<bool, Failure> {
    Ok(formats::is_tracks(&read_bytes(path)?))
}

/// Reads tracks.
pub(super) fn read_tracks(path: &Path) -> Result<Vec<Track>, Failure> {
    read(path, |bytes, _| formats::read_tracks(bytes))
}

/// Reads ground truth: an `.npz` pair with `flow`, or Argoverse 2's labels.
pub(super) fn read_truth(path: &Path) -> Result<(PairTruth, Pair), Failure> {
    read(path, |bytes, name| {
        if !formats::is_pair(bytes) {
            let kind = formats::recognize(bytes, name)?;
            if kind != FileKind::Feather {
                let detail = "truth is an npz pair with flow, or Argoverse 2's flow_labels.feather";
                return Err(FormatError::Unsupported {
                    kind,
                    detail: detail.to_owned(),
                });
            }
            let labels = formats::read_av2_labels(bytes)?;
            let ground = formats::Ground {
                source: labels.ground,
                target: Vec::new(),
            };
            let pair = Pair {
                ground: Some(ground),
                ..Pair::default()
            };
            return Ok((labels.truth, pair));
        }
        let mut pair = formats::read_pair(bytes)?;
        match pair.truth.take() {
            Some(truth) => Ok((truth, pair)),
            None => Err(FormatError::Missing {
                kind: FileKind::Npz,
                what: "flow".to_owned(),
                present: "two clouds without truth".to_owned(),
            }),
        }
    })
}

/// Reads a rigid motion target_from_source: 16 numbers row by row, or the `ego_SE3` of an `.npz`
/// pair.
pub(super) fn read_motion(path: &Path) -> Result<RigidTransform, Failure> {
    let bytes = read_bytes(path)?;
    let motion = if formats::is_pair(&bytes) {
        let pair = formats::read_pair(&bytes).map_err(anyhow::Error::new);
        pair.and_then(|pair| pair.ego.ok_or_else(|| anyhow!("the pair has no ego_SE3")))
    } else {
        formats::read_motion(&bytes).map_err(anyhow::Error::new)
    };
    motion
        .with_context(|| path.display().to_string())
        .map_err(Failure::bad_input)
}

/// Reads Argoverse 2's raster of ground heights, and the raster's transform from the city's frame,
/// which is in the same folder.
pub(super) fn read_ground_raster(path: &Path) -> Result<GroundRaster, Failure> {
    const PLACE: &str = "___img_Sim2_city.json";
    let folder = path.parent().unwrap_or(Path::new(""));
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let log = name.split("_ground_height_surface").next();
    let index = folder.join(format!("{}{PLACE}", log.unwrap_or_default()));
    GroundRaster::read(&read_bytes(path)?, &read_bytes(&index)?)
        .with_context(|| path.display().to_string())
        .map_err(Failure::bad_input)
}

/// Reads a camera: from one file, or from KITTI's `calib_cam_to_cam.txt` with
/// `calib_velo_to_cam.txt` in the same folder.
pub(super) fn read_camera(path: &Path) -> Result<Camera, Failure> {
    read_calibration(path, formats::read_camera)
}

/// Reads KITTI's camera from a calibration as [`read_camera`]'s. JSON has no camera 0.
pub(super) fn read_kitti_camera(path: &Path) -> Result<KittiCamera, Failure> {
    read_calibration(path, |bytes, second| {
        Ok(KittiCamera {
            camera: formats::read_camera(bytes, second)?,
            camera0_from_lidar: formats::read_camera0_from_lidar(bytes, second)?,
        })
    })
}

/// Reads the scenes of nuScenes from the folder of its tables, such as `v1.0-mini`.
pub(super) fn read_nuscenes(tables: &Path) -> Result<Vec<NuscenesScene>, Failure> {
    let mut files: [Vec<u8>; NUSCENES_TABLES.len()] = Default::default();
    for (file, name) in files.iter_mut().zip(NUSCENES_TABLES) {
        *file = read_bytes(&tables.join(name).with_extension("json"))?;
    }
    formats::read_nuscenes(&files)
        .with_context(|| tables.display().to_string())
        .map_err(Failure::bad_input)
}

/// Reads a calibration, and the file that goes with KITTI's `calib_cam_to_cam.txt`.
fn read_calibration<T>(
    path: &Path,
    reader: impl FnOnce(&[u8], Option<&[u8]>) -> Result<T, FormatError>,
) -> Result<T, Failure> {
    let beside = path.with_file_name("calib_velo_to_cam.txt");
    let is_first = path
        .file_name()
        .is_some_and(|name| name == "calib_cam_to_cam.txt");
    let second = is_first.then(|| read_bytes(&beside)).transpose()?;
    read(path, |bytes, _| reader(bytes, second.as_deref()))
}

/// What a regular file is, under all of its names: device and inode.
pub(super) fn identity(path: &Path) -> Option<(u64, u64)> {
    let about = fs::metadata(path).ok().filter(fs::Metadata::is_file)?;
    Some((about.dev(), about.ino()))
}

/// Creates the missing folders of outputs. Refuses outputs that cannot be written, and outputs that
/// are the same file as an input or another output. Called before any work.
pub(super) fn check_outputs<'a>(
    outputs: impl IntoIterator<Item = &'a PathBuf>,
    inputs: impl IntoIterator<Item = &'a PathBuf>,
) -> Result<(), Failure> {
    let mut taken: HashMap<(u64, u64), &Path> = HashMap::new();
    taken.extend(
        inputs
            .into_iter()
            .filter_map(|path| Some((identity(path)?, path.as_path()))),
    );
    let mut indices: HashSet<PathBuf> = HashSet::new();
    for path in outputs {
        let refuse = |why: &str| {
            let message = format!("cannot write {}: {why}", path.display());
            Err(Failure::internal(anyhow!(message)))
        };
        let folder = path.parent().unwrap_or_else(|| Path::new(""));
        if let Err(error) = fs::create_dir_all(folder) {
            return refuse(&format!("its folder cannot be created: {error}"));
        }
        let Some(index) = place_of(path) else {
            return refuse("the folder that its link points to is not there");
        };
        if index.is_dir() {
            return refuse("it is a folder");
        }
        if !index.exists() && access(index.parent().unwrap_or(&index), Access::WRITE_OK).is_err() {
            return refuse("nothing can be written to its folder");
        }
        let same = identity(path).and_then(|identity| taken.insert(identity, path));
        if let Some(same) = same {
            let message = format!(
                "{} would be written over {}: give another name",
                path.display(),
                same.display()
            );
            return Err(Failure::usage(anyhow!(message)));
        }
        if !indices.insert(index) {
            let message = format!(
                "{} would be written twice: give another name",
                path.display()
            );
            return Err(Failure::usage(anyhow!(message)));
        }
    }
    Ok(())
}

/// The absolute path of a file that exists or is to be created, with links and dots resolved.
/// `None` where its folder does not exist.
pub(super) fn place_of(path: &Path) -> Option<PathBuf> {
    const LINKS: usize = 40;
    let mut path = path.to_owned();
    for _ in 0..LINKS {
        if let Ok(index) = fs::canonicalize(&path) {
            return Some(index);
        }
        let folder = path.parent()?;
        let folder = if folder.as_os_str().is_empty() {
            Path::new(".")
        } else {
            folder
        };
        let index = fs::canonicalize(folder).ok()?.join(path.file_name()?);
        // A link to a missing file: its target is the path to be created.
        match fs::read_link(&index) {
            Ok(target) => path = index.parent()?.join(target),
            Err(_) => return Some(index),
        }
    }
    None
}

/// Writes a file through `writer`. A regular file is written under a temporary name and renamed, so
/// a failed write leaves no partial file. Links are followed; pipes and devices are written
/// directly.
pub(super) fn write<E: std::error::Error + Send + Sync + 'static>(
    path: &Path,
    writer: impl FnOnce(&mut BufWriter<File>) -> Result<(), E>,
) -> Result<(), Failure> {
    let written = || -> anyhow::Result<()> {
        let mut output = Output::create(path)?;
        writer(&mut output.file)?;
        output.complete()
    };
    let written = written().with_context(|| format!("cannot write {}", path.display()));
    written.map_err(Failure::of_writing)
}

/// Writes a file below `folder` under a name that is not the user's own. Makes its folders. A link of this
/// name is replaced, not followed.
///
/// # Errors
/// An internal failure where it cannot be written, and where a folder on the way is a link that leads out
/// of `folder`.
pub(super) fn write_below<E: std::error::Error + Send + Sync + 'static>(
    folder: &Path,
    name: &Path,
    writer: impl FnOnce(&mut BufWriter<File>) -> Result<(), E>,
) -> Result<(), Failure> {
    let path = folder.join(name);
    let written = || -> anyhow::Result<()> {
        let parent = path.parent().unwrap_or(folder);
        fs::create_dir_all(parent)?;
        let inner = fs::canonicalize(parent)?;
        if !inner.starts_with(fs::canonicalize(folder)?) {
            return Err(anyhow!("a link leads out of {}", folder.display()));
        }
        let place = inner.join(path.file_name().unwrap_or_default());
        let mut output = Output::replacing(place)?;
        writer(&mut output.file)?;
        output.complete()
    };
    written()
        .with_context(|| format!("cannot write {}", path.display()))
        .map_err(Failure::internal)
}

/// A file that is being written, under a temporary name unless it is a pipe or a device.
pub(super) struct Output {
    pub(super) file: BufWriter<File>,
    /// The temporary file, and the path that it gets in the end.
    unfinished: Option<(Unfinished, PathBuf)>,
}

impl Output {
    /// Begins to write a file, as [`write()`] does.
    pub(super) fn create(path: &Path) -> anyhow::Result<Self> {
        let place = place_of(path).context("its folder is not there")?;
        if place.is_file() || !place.exists() {
            return Self::replacing(place);
        }
        Ok(Self {
            file: BufWriter::new(File::create(&place)?),
            unfinished: None,
        })
    }

    fn replacing(place: PathBuf) -> anyhow::Result<Self> {
        let (unfinished, file) = Unfinished::beside(&place)?;
        Ok(Self {
            file: BufWriter::new(file),
            unfinished: Some((unfinished, place)),
        })
    }

    /// Gives the complete file its name.
    pub(super) fn complete(mut self) -> anyhow::Result<()> {
        self.file.flush()?;
        match self.unfinished {
            Some((unfinished, place)) => Ok(unfinished.rename(&place)?),
            None => Ok(()),
        }
    }
}
