//! `sensor_msgs/msg/PointCloud2` with the fields of Velodyne's, Ouster's and Hesai's drivers.

use super::cdr::{Cdr, Header};
use crate::limits::MOST_POINTS;

/// A cloud with what is known of its points. Points with a coordinate that is not finite are left out.
pub(super) struct Message {
    pub header: Header,
    /// x, y, z and, if there is one, the intensity.
    pub values: Vec<f32>,
    pub channels: usize,
    pub ring: Option<Vec<u16>>,
    /// Seconds relative to the stamp.
    pub time_s: Option<Vec<f32>>,
}

/// Names of the intensity, the ring and the time, by driver.
const INTENSITY: &[&str] = &["intensity", "reflectivity", "signal", "i"];
const RING: &[&str] = &["ring", "channel", "laser_id", "line"];
const TIME: &[&str] = &["time", "t", "timestamp", "time_stamp", "offset_time"];

/// Most fields of a point.
const MOST_FIELDS: u32 = 256;

/// A field of a point.
struct Field {
    name: String,
    offset: usize,
    kind: Kind,
}

/// Types of `sensor_msgs/msg/PointField`.
#[derive(Clone, Copy, PartialEq)]
enum Kind {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Kind {
    fn of(code: u8) -> Option<Kind> {
        use Kind::*;
        [I8, U8, I16, U16, I32, U32, F32, F64].get(usize::from(code).checked_sub(1)?).copied()
    }

    fn size(self) -> usize {
        match self {
            Kind::I8 | Kind::U8 => 1,
            Kind::I16 | Kind::U16 => 2,
            Kind::I32 | Kind::U32 | Kind::F32 => 4,
            Kind::F64 => 8,
        }
    }

    fn read(self, bytes: &[u8], big_endian: bool) -> f64 {
        let mut raw = [0u8; 8];
        let size = self.size();
        raw[..size].copy_from_slice(&bytes[..size]);
        if big_endian {
            raw[..size].reverse();
        }
        let [a, b, c, d, ..] = raw;
        match self {
            Kind::I8 => f64::from(a as i8),
            Kind::U8 => f64::from(a),
            Kind::I16 => f64::from(i16::from_le_bytes([a, b])),
            Kind::U16 => f64::from(u16::from_le_bytes([a, b])),
            Kind::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            Kind::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            Kind::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            Kind::F64 => f64::from_le_bytes(raw),
        }
    }
}

/// The header alone.
pub(super) fn header(message: &[u8]) -> Result<Header, String> {
    Cdr::new(message)?.header()
}

/// Parses a message.
///
/// # Errors
/// What is wrong with it, without the name of the file.
pub(super) fn parse(message: &[u8]) -> Result<Message, String> {
    let mut cdr = Cdr::new(message)?;
    let header = cdr.header()?;
    let (height, width) = (cdr.u32()? as usize, cdr.u32()? as usize);
    let mut fields = Vec::new();
    let count = cdr.u32()?;
    if count > MOST_FIELDS {
        return Err(format!("its points have {count} fields; at most {MOST_FIELDS} are read"));
    }
    for _ in 0..count {
        let (name, offset, code, _count) = (cdr.string()?, cdr.u32()? as usize, cdr.u8()?, cdr.u32()?);
        let kind = Kind::of(code).ok_or_else(|| format!("its field {name:?} has the unknown type {code}"))?;
        fields.push(Field { name, offset, kind });
    }
    let big_endian = cdr.u8()? != 0;
    let (point_step, row_step) = (cdr.u32()? as usize, cdr.u32()? as usize);
    let data = cdr.bytes()?;
    let points = height.saturating_mul(width);
    if points > MOST_POINTS {
        return Err(format!("it has {points} points; at most {MOST_POINTS} are supported"));
    }
    if let Some(f) = fields.iter().find(|f| f.offset.saturating_add(f.kind.size()) > point_step) {
        return Err(format!("its field {:?} ends behind the {point_step} bytes of a point", f.name));
    }
    let needed = match (height, width) {
        (0, _) | (_, 0) => 0,
        _ => (height - 1).saturating_mul(row_step).saturating_add(width.saturating_mul(point_step)),
    };
    if data.len() < needed || (height > 1 && row_step < width * point_step) {
        return Err(format!(
            "it has {} bytes for {height} rows of {width} points of {point_step} bytes at steps of {row_step}",
            data.len()
        ));
    }
    let find = |names: &[&str]| names.iter().find_map(|name| fields.iter().find(|f| f.name == *name));
    let [x, y, z] =
        ["x", "y", "z"].map(|name| find(&[name]).ok_or_else(|| format!("its points have no field {name:?}")));
    let (x, y, z) = (x?, y?, z?);
    let (intensity, ring, time) = (find(INTENSITY), find(RING), find(TIME));
    let channels = if intensity.is_some() { 4 } else { 3 };
    let mut out = Message {
        header,
        values: Vec::with_capacity(points * channels),
        channels,
        ring: ring.map(|_| Vec::with_capacity(points)),
        time_s: None,
    };
    let mut times = Vec::new();
    for row in 0..height {
        for column in 0..width {
            let point = &data[row * row_step + column * point_step..][..point_step];
            let value = |f: &Field| f.kind.read(&point[f.offset..], big_endian);
            let at = [x, y, z].map(|f| value(f) as f32);
            if at.iter().any(|v| !v.is_finite()) {
                continue;
            }
            out.values.extend(at);
            out.values.extend(intensity.map(|f| value(f) as f32));
            if let (Some(field), Some(rings)) = (ring, &mut out.ring) {
                rings.push(value(field) as u16);
            }
            times.extend(time.map(value));
        }
    }
    out.time_s = time.map(|field| seconds(field.kind, &times, out.header.stamp_ns));
    Ok(out)
}

/// Times as seconds relative to the stamp. Whole numbers are nanoseconds (Ouster `t`, Livox `offset_time`). Floats are
/// seconds (Velodyne `time`), since 1970 if they are large (Hesai `timestamp`), or nanoseconds since 1970 if they are
/// very large (Livox `timestamp`).
fn seconds(kind: Kind, times: &[f64], stamp_ns: i64) -> Vec<f32> {
    let stamp_s = stamp_ns as f64 * 1e-9;
    let whole = !matches!(kind, Kind::F32 | Kind::F64);
    let second = |v: f64| match v {
        v if whole => v * 1e-9,
        v if v > 1e15 => (v - stamp_ns as f64) * 1e-9,
        v if v > 1e6 => v - stamp_s,
        v => v,
    };
    times.iter().map(|v| second(*v) as f32).collect()
}
