//! Writes CDR, the encoding of ROS 2 messages, in little-endian order.

use geometry::Pose;

/// A message that is written value by value.
pub(super) struct Out {
    /// Behind the four bytes of the encapsulation, from which alignment counts.
    bytes: Vec<u8>,
}

impl Out {
    pub fn new() -> Out {
        Out { bytes: Vec::new() }
    }

    fn push<const N: usize>(&mut self, little: [u8; N]) -> &mut Self {
        self.bytes.resize(self.bytes.len().next_multiple_of(N), 0);
        self.bytes.extend(little);
        self
    }

    pub fn u8(&mut self, v: u8) -> &mut Self {
        self.push([v])
    }

    pub fn u32(&mut self, v: u32) -> &mut Self {
        self.push(v.to_le_bytes())
    }

    pub fn f32(&mut self, v: f32) -> &mut Self {
        self.push(v.to_le_bytes())
    }

    pub fn f64(&mut self, v: f64) -> &mut Self {
        self.push(v.to_le_bytes())
    }

    /// A string, which ends with a zero byte.
    pub fn text(&mut self, text: &str) -> &mut Self {
        self.u32(text.len() as u32 + 1);
        self.bytes.extend(text.as_bytes());
        self.bytes.push(0);
        self
    }

    /// A sequence of bytes.
    pub fn sequence(&mut self, bytes: &[u8]) -> &mut Self {
        self.u32(bytes.len() as u32);
        self.bytes.extend(bytes);
        self
    }

    pub fn header(&mut self, stamp_ns: u64, frame: &str) -> &mut Self {
        self.u32((stamp_ns / 1_000_000_000) as u32).u32((stamp_ns % 1_000_000_000) as u32).text(frame)
    }

    /// Position x, y, z and orientation x, y, z, w.
    pub fn pose(&mut self, pose: &Pose) -> &mut Self {
        let (t, q) = (&pose.translation, &pose.rotation);
        for v in [t.x, t.y, t.z, q.i, q.j, q.k, q.w] {
            self.f64(v);
        }
        self
    }

    pub fn message(&self) -> Vec<u8> {
        [&[0, 1, 0, 0][..], &self.bytes].concat()
    }
}
