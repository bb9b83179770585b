//! PLY: a text header that declares elements and properties, then rows in text or binary.
//!
//! Reads the wanted scalar properties of the vertex element and skips all others. Independent of
//! the meaning of the properties.

use std::io::Write;

use super::error::{FileKind, FormatError, shorten};
use super::limits::{check_rows, check_size};
use super::lines::{header_line, next_line};
use super::scalar::{ByteOrder, Scalar};

const KIND: FileKind = FileKind::Ply;

/// Size limit of a header, bytes. Typical ones have a few hundred; comments may make them longer.
const MAX_HEADER: usize = 64 << 10;

enum Property {
    Scalar { name: String, scalar: Scalar },
    List { count: Scalar, item: Scalar },
}

struct Element {
    name: String,
    rows: u64,
    properties: Vec<Property>,
}

impl Element {
    /// Bytes of one binary row; `None` where a list makes rows vary.
    fn stride(&self) -> Option<usize> {
        self.properties
            .iter()
            .try_fold(0_usize, |sum, property| match property {
                Property::Scalar { scalar, .. } => sum.checked_add(scalar.size()),
                Property::List { .. } => None,
            })
    }
}

#[derive(Clone, Copy)]
enum Encoding {
    Ascii,
    Binary(ByteOrder),
}

/// A file whose header has been read.
pub(super) struct Ply<'a> {
    encoding: Encoding,
    elements: Vec<Element>,
    body: &'a [u8],
}

impl<'a> Ply<'a> {
    /// Reads the header.
    pub(super) fn open(bytes: &'a [u8]) -> Result<Self, FormatError> {
        let mut encoding = None;
        let mut elements: Vec<Element> = Vec::new();
        let mut rest = bytes;
        let mut first = true;
        loop {
            let left = MAX_HEADER.saturating_sub(bytes.len() - rest.len());
            let line = header_line(&mut rest, left)
                .map_err(|_| KIND.malformed("no end_header in the first 64 KiB"))?
                .ok_or_else(|| KIND.malformed("no end_header"))?;
            let line = std::str::from_utf8(line)
                .map_err(|_| KIND.malformed("the header is not text"))?
                .trim();
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            let wrong = || KIND.malformed(format!("header line {:?}", shorten(line)));
            match words[..] {
                ["ply"] if first => {}
                _ if first => return Err(wrong()),
                ["format", "ascii", _] => encoding = Some(Encoding::Ascii),
                ["format", "binary_little_endian", _] => {
                    encoding = Some(Encoding::Binary(ByteOrder::Little));
                }
                ["format", "binary_big_endian", _] => {
                    encoding = Some(Encoding::Binary(ByteOrder::Big));
                }
                ["comment" | "obj_info", ..] | [] => {}
                ["element", name, rows] => elements.push(Element {
                    name: name.to_owned(),
                    rows: rows.parse().map_err(|_| wrong())?,
                    properties: Vec::new(),
                }),
                ["property", "list", count, item, _name] => {
                    let count = scalar(count)
                        .filter(|count| !count.is_float())
                        .ok_or_else(wrong)?;
                    let item = scalar(item).ok_or_else(wrong)?;
                    let element = elements.last_mut().ok_or_else(wrong)?;
                    element.properties.push(Property::List { count, item });
                }
                ["property", kind, name] => {
                    let scalar = scalar(kind).ok_or_else(wrong)?;
                    let name = name.to_owned();
                    let element = elements.last_mut().ok_or_else(wrong)?;
                    element.properties.push(Property::Scalar { name, scalar });
                }
                ["end_header"] => break,
                _ => return Err(wrong()),
            }
            first = false;
        }
        let encoding = encoding.ok_or_else(|| KIND.malformed("the header names no format"))?;
        Ok(Self {
            encoding,
            elements,
            body: rest,
        })
    }

    fn vertex(&self) -> Result<&Element, FormatError> {
        let is_vertex = |element: &&Element| element.name == "vertex";
        self.elements.iter().find(is_vertex).ok_or_else(|| {
            let names: Vec<String> = self
                .elements
                .iter()
                .map(|element| shorten(&element.name))
                .collect();
            KIND.missing("element vertex", &names)
        })
    }

    /// The number of vertices declared.
    pub(super) fn rows(&self) -> Result<usize, FormatError> {
        check_rows(KIND, self.vertex()?.rows)
    }

    /// The type of the scalar vertex property `wanted`, where it exists.
    pub(super) fn property(&self, wanted: &str) -> Option<Scalar> {
        let properties = &self.vertex().ok()?.properties;
        properties.iter().find_map(|property| match property {
            Property::Scalar { name, scalar } if name == wanted => Some(*scalar),
            _ => None,
        })
    }

    /// Checks the declared counts against the bytes present. Then calls `take` with the row and
    /// values of every vertex, the values being those of the `wanted` properties in that order.
    pub(super) fn each(
        &self,
        wanted: &[&str],
        mut take: impl FnMut(usize, &[f64]) -> Result<(), FormatError>,
    ) -> Result<(), FormatError> {
        let vertex = self.vertex()?;
        let rows = check_rows(KIND, vertex.rows)?;
        let slots = self.slots(vertex, wanted)?;
        let mut body = self.body;
        for element in self
            .elements
            .iter()
            .take_while(|element| element.name != "vertex")
        {
            self.skip(element, &mut body)?;
        }
        // A list takes at least one byte, an ascii number at least a digit and a separator.
        let least = match self.encoding {
            Encoding::Ascii => vertex.properties.len().saturating_mul(2),
            Encoding::Binary(_) => vertex.stride().unwrap_or(vertex.properties.len()),
        };
        check_size(KIND, rows, least, body.len().saturating_add(1))?;
        let mut values = vec![0.0; wanted.len()];
        for row in 0..rows {
            self.row(vertex, &slots, &mut body, &mut values)
                .ok_or_else(|| {
                    KIND.malformed(format!(
                        "vertex {row} of {rows} ends early or is not a row of numbers"
                    ))
                })?;
            take(row, &values)?;
        }
        Ok(())
    }

    /// For every property of the vertex, its index in `wanted`.
    fn slots(&self, vertex: &Element, wanted: &[&str]) -> Result<Vec<Option<usize>>, FormatError> {
        let name_of = |property: &Property| match property {
            Property::Scalar { name, .. } => Some(name.clone()),
            Property::List { .. } => None,
        };
        let names: Vec<Option<String>> = vertex.properties.iter().map(name_of).collect();
        for name in wanted {
            if self.property(name).is_none() {
                let present: Vec<String> =
                    names.iter().flatten().map(|name| shorten(name)).collect();
                return Err(KIND.missing(format!("vertex property {name}"), &present));
            }
        }
        let slot = |name: &Option<String>| {
            let name = name.as_deref()?;
            wanted.iter().position(|candidate| *candidate == name)
        };
        Ok(names.iter().map(slot).collect())
    }

    /// Reads one row; `None` where it is truncated or contains a word that is not a number.
    fn row(
        &self,
        element: &Element,
        slots: &[Option<usize>],
        body: &mut &[u8],
        values: &mut [f64],
    ) -> Option<()> {
        match self.encoding {
            Encoding::Ascii => {
                let line = std::str::from_utf8(next_line(body)?).ok()?;
                let mut words = line.split_ascii_whitespace();
                for (property, slot) in element.properties.iter().zip(slots) {
                    match property {
                        Property::Scalar { .. } => {
                            let value: f64 = words.next()?.parse().ok()?;
                            if let Some(slot) = slot {
                                values[*slot] = value;
                            }
                        }
                        Property::List { .. } => {
                            let count: usize = words.next()?.parse().ok()?;
                            for _ in 0..count {
                                words.next()?;
                            }
                        }
                    }
                }
            }
            Encoding::Binary(order) => {
                for (property, slot) in element.properties.iter().zip(slots) {
                    match property {
                        Property::Scalar { scalar, .. } => {
                            let value = scalar.decode(body, order)?;
                            *body = body.get(scalar.size()..)?;
                            if let Some(slot) = slot {
                                values[*slot] = value;
                            }
                        }
                        Property::List { count, item } => skip_list(*count, *item, order, body)?,
                    }
                }
            }
        }
        Some(())
    }

    /// Skips an element that comes before the vertices.
    fn skip(&self, element: &Element, body: &mut &[u8]) -> Result<(), FormatError> {
        let early = || KIND.malformed(format!("element {} ends early", shorten(&element.name)));
        if let (Encoding::Binary(_), Some(stride)) = (self.encoding, element.stride()) {
            let bytes = usize::try_from(element.rows)
                .ok()
                .and_then(|rows| rows.checked_mul(stride))
                .ok_or_else(early)?;
            *body = body.get(bytes..).ok_or_else(early)?;
            return Ok(());
        }
        let slots = vec![None; element.properties.len()];
        for _ in 0..element.rows {
            self.row(element, &slots, body, &mut []).ok_or_else(early)?;
        }
        Ok(())
    }
}

fn skip_list(count: Scalar, item: Scalar, order: ByteOrder, body: &mut &[u8]) -> Option<()> {
    let items = count.decode(body, order)?;
    if items < 0.0 {
        return None;
    }
    // A count too large for `usize` saturates, and the next lines then refuse it.
    let bytes = (items as usize)
        .checked_mul(item.size())?
        .checked_add(count.size())?;
    *body = body.get(bytes..)?;
    Some(())
}

fn scalar(name: &str) -> Option<Scalar> {
    Some(match name {
        "char" | "int8" => Scalar::I8,
        "uchar" | "uint8" => Scalar::U8,
        "short" | "int16" => Scalar::I16,
        "ushort" | "uint16" => Scalar::U16,
        "int" | "int32" => Scalar::I32,
        "uint" | "uint32" => Scalar::U32,
        "float" | "float32" => Scalar::F32,
        "double" | "float64" => Scalar::F64,
        _ => return None,
    })
}

/// Writes the header of a little-endian file of `rows` vertices; properties as (type, name).
pub(super) fn write_header(
    out: &mut dyn Write,
    rows: usize,
    comments: &[&str],
    properties: &[(&str, &str)],
) -> Result<(), FormatError> {
    write!(out, "ply\nformat binary_little_endian 1.0\n")?;
    for comment in comments {
        writeln!(out, "comment {comment}")?;
    }
    writeln!(out, "element vertex {rows}")?;
    for (kind, name) in properties {
        writeln!(out, "property {kind} {name}")?;
    }
    writeln!(out, "end_header")?;
    Ok(())
}
