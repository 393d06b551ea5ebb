//! The header of a PCD file.

use crate::DataError;
use crate::limits::{MOST_PCD_FIELDS, MOST_POINTS, at_most};
use std::path::Path;

/// Encoding of the points of a PCD.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PcdEncoding {
    /// Text, one point a line.
    Ascii,
    /// Little-endian numbers, one point after the other.
    Binary,
    /// Little-endian numbers, one field after the other, compressed by LZF.
    BinaryCompressed,
}

impl PcdEncoding {
    /// Its keyword in the DATA line.
    pub fn keyword(self) -> &'static str {
        match self {
            PcdEncoding::Ascii => "ascii",
            PcdEncoding::Binary => "binary",
            PcdEncoding::BinaryCompressed => "binary_compressed",
        }
    }
}

/// Number format of a field: TYPE and SIZE in bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PcdNumber {
    F4,
    F8,
    I1,
    I2,
    I4,
    I8,
    U1,
    U2,
    U4,
    U8,
}

impl PcdNumber {
    fn of(kind: &str, size: u64) -> Option<Self> {
        use PcdNumber::*;
        Some(match (kind, size) {
            ("F", 4) => F4,
            ("F", 8) => F8,
            ("I", 1) => I1,
            ("I", 2) => I2,
            ("I", 4) => I4,
            ("I", 8) => I8,
            ("U", 1) => U1,
            ("U", 2) => U2,
            ("U", 4) => U4,
            ("U", 8) => U8,
            _ => return None,
        })
    }

    /// Reads the first number of each of `cells` and converts it to f32.
    pub(crate) fn read_all<'a>(self, cells: impl Iterator<Item = &'a [u8]>, to: impl Iterator<Item = &'a mut f32>) {
        macro_rules! read {
            ($number:ty) => {
                for (cell, to) in cells.zip(to) {
                    let mut bytes = [0; size_of::<$number>()];
                    bytes.copy_from_slice(&cell[..size_of::<$number>()]);
                    *to = <$number>::from_le_bytes(bytes) as f32;
                }
            };
        }
        match self {
            PcdNumber::F4 => read!(f32),
            PcdNumber::F8 => read!(f64),
            PcdNumber::I1 => read!(i8),
            PcdNumber::I2 => read!(i16),
            PcdNumber::I4 => read!(i32),
            PcdNumber::I8 => read!(i64),
            PcdNumber::U1 => read!(u8),
            PcdNumber::U2 => read!(u16),
            PcdNumber::U4 => read!(u32),
            PcdNumber::U8 => read!(u64),
        }
    }
}

/// A field of a point.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct PcdField {
    pub(crate) name: String,
    pub(crate) number: PcdNumber,
    size: u64,
    count: u64,
    /// Offset in a point, bytes.
    pub(crate) offset: usize,
    /// Index of its first number in a point.
    pub(crate) first_number: usize,
}

impl PcdField {
    pub(crate) fn bytes(&self) -> usize {
        (self.size * self.count) as usize
    }
}

/// The header of a PCD file.
#[derive(Clone, Debug, PartialEq)]
pub struct PcdHeader {
    pub(crate) fields: Vec<PcdField>,
    pub(crate) height: u64,
    pub(crate) points: u64,
    pub(crate) encoding: PcdEncoding,
    pub(crate) point_bytes: u64,
    pub(crate) numbers_per_point: usize,
    /// Offset of the points in the file, bytes.
    pub(crate) body_start: usize,
    /// Line of the first point, from 1.
    pub(crate) body_line: usize,
}

impl PcdHeader {
    /// Whether the points have an intensity.
    pub fn has_intensity(&self) -> bool {
        self.columns().len() == 4
    }

    /// Encoding of the points.
    pub fn encoding(&self) -> PcdEncoding {
        self.encoding
    }

    /// The fields x, y, z and, if present, intensity (named `intensity` or `i`).
    pub(crate) fn columns(&self) -> Vec<&PcdField> {
        let named = |name: &str| self.fields.iter().find(|f| f.name == name);
        ["x", "y", "z"].into_iter().filter_map(named).chain(named("intensity").or_else(|| named("i"))).collect()
    }

    /// Size of all points without compression, bytes.
    pub(crate) fn body_bytes(&self, path: &Path) -> Result<u64, DataError> {
        let bytes = self.points.checked_mul(self.point_bytes).filter(|bytes| *bytes <= isize::MAX as u64);
        bytes.ok_or_else(|| {
            DataError::file(path, format!("its header says {} points, which is too large for a file", self.points))
        })
    }
}

/// Parses the header of a PCD. `path` is used in error messages.
pub fn parse_pcd_header(bytes: &[u8], path: &Path) -> Result<PcdHeader, DataError> {
    let mut entries: Vec<(&str, Vec<&str>, usize)> = Vec::new();
    let (mut at, mut number) = (0, 0);
    let encoding = loop {
        number += 1;
        let wrong = |message: String| DataError::line(path, number, message);
        let rest = bytes.get(at..).unwrap_or_default();
        if rest.is_empty() {
            return Err(DataError::file(path, "is not a PCD: its header has no DATA line"));
        }
        let length = rest.iter().position(|b| *b == b'\n').unwrap_or(rest.len());
        at += length + 1;
        let line = std::str::from_utf8(&rest[..length])
            .map_err(|_| wrong("is not a line of a PCD header: not UTF-8 text".into()))?;
        let mut tokens = line.split_ascii_whitespace();
        let key = match tokens.next() {
            Some(key) if !key.starts_with('#') => key,
            _ => continue,
        };
        if !["VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA"]
            .contains(&key)
        {
            return Err(wrong(format!("{key:?} is not a PCD header entry")));
        }
        if entries.iter().any(|(known, ..)| *known == key) {
            return Err(wrong(format!("{key} occurs twice")));
        }
        let values: Vec<&str> = tokens.collect();
        if key == "DATA" {
            let encodings = [PcdEncoding::Ascii, PcdEncoding::Binary, PcdEncoding::BinaryCompressed];
            break encodings.into_iter().find(|e| values == [e.keyword()]).ok_or_else(|| {
                wrong(format!("DATA {:?} is not ascii, binary or binary_compressed", values.join(" ")))
            })?;
        }
        entries.push((key, values, number));
    };
    let find = |key: &str| entries.iter().find(|(known, ..)| *known == key);
    let need = |key: &str| find(key).ok_or_else(|| DataError::file(path, format!("its PCD header has no {key}")));

    let (_, version, line) = need("VERSION")?;
    if !matches!(version[..], ["0.7" | ".7" | "0.6" | ".6"]) {
        return Err(DataError::line(path, *line, format!("VERSION {} is not 0.7", version.join(" "))));
    }
    let fields = fields(need("FIELDS")?, need("SIZE")?, need("TYPE")?, find("COUNT"), path)?;
    let point_bytes = fields.iter().map(|f| f.size * f.count).sum();
    let numbers_per_point = fields.iter().map(|f| f.count as usize).sum();

    let whole = |entry: &(&str, Vec<&str>, usize)| match entry.1[..] {
        [value] if value.bytes().all(|b| b.is_ascii_digit()) => value.parse::<u64>().ok(),
        _ => None,
    };
    let size = |key: &str| {
        let entry = need(key)?;
        whole(entry).ok_or_else(|| {
            DataError::line(path, entry.2, format!("{key} {:?} is not a whole number", entry.1.join(" ")))
        })
    };
    let (width, height) = (size("WIDTH")?, size("HEIGHT")?);
    let points = width
        .checked_mul(height)
        .ok_or_else(|| DataError::file(path, format!("WIDTH {width} x HEIGHT {height} is too large")))?;
    if let Some(entry) = find("POINTS")
        && size("POINTS")? != points
    {
        let message = format!("POINTS {} is not WIDTH {width} x HEIGHT {height}", entry.1.join(" "));
        return Err(DataError::line(path, entry.2, message));
    }
    at_most(path, "points in its header", points, MOST_POINTS)?;
    let body_start = at.min(bytes.len());
    Ok(PcdHeader {
        fields,
        height,
        points,
        encoding,
        point_bytes,
        numbers_per_point,
        body_start,
        body_line: number + 1,
    })
}

type Entry<'a> = (&'a str, Vec<&'a str>, usize);

fn fields(
    names: &Entry,
    sizes: &Entry,
    types: &Entry,
    counts: Option<&Entry>,
    path: &Path,
) -> Result<Vec<PcdField>, DataError> {
    for (key, values, line) in [Some(sizes), Some(types), counts].into_iter().flatten() {
        if values.len() != names.1.len() {
            let message = format!("{key} has {} values, but FIELDS has {}", values.len(), names.1.len());
            return Err(DataError::line(path, *line, message));
        }
    }
    if names.1.len() > MOST_PCD_FIELDS {
        let message = format!("FIELDS has {} names; at most {MOST_PCD_FIELDS} are supported", names.1.len());
        return Err(DataError::line(path, names.2, message));
    }
    let (mut fields, mut offset, mut first_number) = (Vec::<PcdField>::new(), 0usize, 0usize);
    for (i, name) in names.1.iter().enumerate() {
        // Padding fields (`_`) may repeat.
        if *name != "_" && fields.iter().any(|f| f.name == *name) {
            return Err(DataError::line(path, names.2, format!("FIELDS has {name} twice")));
        }
        let size = sizes.1[i].parse().unwrap_or(0);
        let number = PcdNumber::of(types.1[i], size).ok_or_else(|| {
            DataError::line(
                path,
                types.2,
                format!("{name}: TYPE {} of size {} is not supported", types.1[i], sizes.1[i]),
            )
        })?;
        let wanted = ["x", "y", "z", "intensity", "i"].contains(name);
        let count = match counts {
            None => 1,
            // COUNT is limited, so that the sums below cannot overflow.
            Some((_, counts, line)) => match counts[i].parse::<u64>() {
                Ok(count) if (1..=1 << 20).contains(&count) && (count == 1 || !wanted) => count,
                _ => return Err(DataError::line(path, *line, format!("{name} has COUNT {}", counts[i]))),
            },
        };
        fields.push(PcdField { name: name.to_string(), number, size, count, offset, first_number });
        offset += (size * count) as usize;
        first_number += count as usize;
    }
    for name in ["x", "y", "z"] {
        if !fields.iter().any(|f| f.name == name) {
            return Err(DataError::line(path, names.2, format!("FIELDS has no {name}")));
        }
    }
    Ok(fields)
}
