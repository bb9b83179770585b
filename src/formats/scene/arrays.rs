//! The arrays of an HDF5 file, decoded to float64.

use hdf5_reader::Datatype;
use hdf5_reader::error::Error;
use hdf5_reader::group::Group;

use crate::formats::error::{FileKind, FormatError};
use crate::formats::limits::check_rows;
use crate::formats::scalar::{ByteOrder, Scalar};

pub(super) const KIND: FileKind = FileKind::Hdf5;

/// What the library says of a damaged file.
pub(super) fn malformed(error: &Error) -> FormatError {
    match error {
        Error::ResourceLimit(limit) => KIND.too_large(limit.clone()),
        error => KIND.malformed(error.to_string()),
    }
}

/// An array of rows of numbers, in the order of its file.
pub(super) struct Array {
    pub(super) rows: usize,
    /// Numbers in a row.
    pub(super) columns: usize,
    scalar: Scalar,
    bytes: Vec<u8>,
}

impl Array {
    /// Reads the array `name` of a group; None where there is none.
    ///
    /// # Errors
    /// - `Malformed` for a file that violates the format.
    /// - `Unsupported` for an array of anything but numbers and booleans, or of more than two dimensions.
    /// - `TooLarge` for more than [`MAX_POINTS`](crate::formats::MAX_POINTS) rows, or more bytes than the
    ///   file may unfold to.
    pub(super) fn read(group: &Group, name: &str) -> Result<Option<Self>, FormatError> {
        let (_, arrays) = group.member_names().map_err(|error| malformed(&error))?;
        if !arrays.iter().any(|array| array == name) {
            return Ok(None);
        }
        let array = group.dataset(name).map_err(|error| malformed(&error))?;
        let (rows, columns) = match *array.shape() {
            [rows] => (rows, 1),
            [rows, columns] => (rows, columns),
            _ => {
                let text = format!("{name} has {} dimensions, not 1 or 2", array.ndim());
                return Err(KIND.unsupported(text));
            }
        };
        let rows = check_rows(KIND, rows)?;
        let scalar = scalar(array.dtype());
        let scalar = scalar.ok_or_else(|| KIND.unsupported(format!("{name} has no numbers")))?;
        let bytes = array.read_native_bytes();
        let bytes = bytes.map_err(|error| malformed(&error))?;
        Ok(Some(Self {
            rows,
            // The bytes are there, so their number is one of this machine.
            columns: columns as usize,
            scalar,
            bytes,
        }))
    }

    /// The numbers of a row, the first ones.
    pub(super) fn row<const N: usize>(&self, row: usize) -> [f64; N] {
        core::array::from_fn(|column| {
            let at = (row * self.columns + column) * self.scalar.size();
            let bytes = self.bytes.get(at..).unwrap_or_default();
            let order = match cfg!(target_endian = "big") {
                true => ByteOrder::Big,
                false => ByteOrder::Little,
            };
            self.scalar.decode(bytes, order).unwrap_or(f64::NAN)
        })
    }
}

/// Bytes of the arrays of a group that are read, as it declares them.
pub(super) fn declared_bytes(group: &Group) -> u64 {
    const READ: [&str; 6] = [
        "lidar",
        "ground_mask",
        "lidar_dt",
        "flow",
        "flow_is_valid",
        "flow_category_indices",
    ];
    let arrays = READ.into_iter().filter_map(|name| group.dataset(name).ok());
    let bytes = arrays.map(|array| {
        let size = scalar(array.dtype()).map_or(0, Scalar::size) as u64;
        let numbers = array.shape().iter().copied();
        numbers.fold(size, u64::saturating_mul)
    });
    bytes.fold(0, u64::saturating_add)
}

/// The type of an array's numbers. A boolean of h5py is an enumeration of bytes.
fn scalar(datatype: &Datatype) -> Option<Scalar> {
    Some(match datatype {
        Datatype::Enum { base, .. } => return scalar(base),
        Datatype::FloatingPoint { size: 2, .. } => Scalar::F16,
        Datatype::FloatingPoint { size: 4, .. } => Scalar::F32,
        Datatype::FloatingPoint { size: 8, .. } => Scalar::F64,
        Datatype::FixedPoint { size, signed, .. } => match (size, signed) {
            (1, false) => Scalar::U8,
            (1, true) => Scalar::I8,
            (2, false) => Scalar::U16,
            (2, true) => Scalar::I16,
            (4, false) => Scalar::U32,
            (4, true) => Scalar::I32,
            (8, false) => Scalar::U64,
            (8, true) => Scalar::I64,
            _ => return None,
        },
        _ => return None,
    })
}
