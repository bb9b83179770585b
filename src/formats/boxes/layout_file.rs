//! A file of a layout, and its parts in JSON.

use serde_json::{Value, json};

use crate::flow::Point;

/// A file of a layout.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LayoutFile {
    /// Path in the folder of the layout, with `/`.
    pub path: String,
    /// Its content.
    pub bytes: Vec<u8>,
}

impl LayoutFile {
    pub(super) fn json(path: impl Into<String>, content: &Value) -> Self {
        Self {
            path: path.into(),
            bytes: format!("{content:#}\n").into_bytes(),
        }
    }
}

/// A vector as an object, to a millionth.
pub(super) fn vector(vector: Point) -> Value {
    let [x, y, z] = vector.map(|value| (f64::from(value) * 1e6).round() / 1e6);
    json!({"x": x, "y": y, "z": z})
}
