//! CDR, the encoding of ROS 2 messages. Four bytes say the byte order; alignment counts from behind them.

use geometry::Pose;
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

/// A message that is read from its beginning.
pub(super) struct Cdr<'a> {
    bytes: &'a [u8],
    at: usize,
    big_endian: bool,
}

/// The stamp and the frame of a message.
pub(super) struct Header {
    /// Seconds and nanoseconds.
    pub stamp_ns: i64,
    /// Name of the frame.
    pub frame: String,
}

impl<'a> Cdr<'a> {
    /// # Errors
    /// An encapsulation that is not plain CDR.
    pub fn new(message: &'a [u8]) -> Result<Self, String> {
        match message {
            [0, order @ (0 | 1), _, _, bytes @ ..] => Ok(Cdr { bytes, at: 0, big_endian: *order == 0 }),
            [a, b, ..] => Err(format!("its encapsulation {a} {b} is not plain CDR")),
            _ => Err("it is shorter than its encapsulation".into()),
        }
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let at = self.at.next_multiple_of(N);
        let found = self.bytes.get(at..).and_then(|rest| rest.first_chunk::<N>());
        let mut value = *found.ok_or_else(|| format!("it ends at byte {} within a value", self.bytes.len()))?;
        self.at = at + N;
        if self.big_endian {
            value.reverse();
        }
        Ok(value)
    }

    pub fn u8(&mut self) -> Result<u8, String> {
        self.array::<1>().map(|[v]| v)
    }

    pub fn u32(&mut self) -> Result<u32, String> {
        self.array().map(u32::from_le_bytes)
    }

    pub fn f64(&mut self) -> Result<f64, String> {
        self.array().map(f64::from_le_bytes)
    }

    /// A sequence of bytes.
    pub fn bytes(&mut self) -> Result<&'a [u8], String> {
        let length = self.u32()? as usize;
        let found = self.bytes.get(self.at..).and_then(|rest| rest.get(..length));
        let left = self.bytes.len() - self.at;
        let found = found.ok_or_else(|| format!("it says that {length} bytes follow, but {left} do"))?;
        self.at += length;
        Ok(found)
    }

    /// A string, which ends with a zero byte.
    pub fn string(&mut self) -> Result<String, String> {
        let bytes = self.bytes()?;
        let bytes = bytes.strip_suffix(&[0]).unwrap_or(bytes);
        String::from_utf8(bytes.to_vec()).map_err(|_| "a string in it is not UTF-8".into())
    }

    pub fn header(&mut self) -> Result<Header, String> {
        let (seconds, nanoseconds) = (self.u32()? as i32, self.u32()?);
        let stamp_ns = i64::from(seconds) * 1_000_000_000 + i64::from(nanoseconds);
        // A slash in front is of ROS 1.
        Ok(Header { stamp_ns, frame: self.string()?.trim_start_matches('/').to_string() })
    }

    /// Position x, y, z and orientation x, y, z, w.
    pub fn pose(&mut self) -> Result<Pose, String> {
        let mut v = [0.0; 7];
        for value in &mut v {
            *value = self.f64()?;
        }
        let [x, y, z, i, j, k, w] = v;
        let rotation = Quaternion::new(w, i, j, k);
        if v.iter().any(|v| !v.is_finite()) || (rotation.norm() - 1.0).abs() > 1e-2 {
            return Err("a pose in it has no unit quaternion".into());
        }
        Ok(Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_quaternion(rotation)))
    }
}
