//! A fingerprint of the content of frames, affordable for large data sets.

use crate::checksum::{files_sha256_bytes, hex};
use crate::frame_index::FrameIndex;
use crate::{DataError, Dataset, FilePart};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::io::Read as _;

/// Pieces of a cloud that are read.
const PIECES: u64 = 16;

/// Frames that are read in parallel before their hashes are added.
const AT_ONCE: usize = 1 << 14;

/// Length of a piece, bytes.
const PIECE_BYTES: u64 = 4096;

impl Dataset {
    /// SHA-256 of the content of frames, in hexadecimal: their ids, the size of each cloud with 64 KiB of it, and whole
    /// labels and calibrations. A cloud of up to 64 KiB is read whole. Of a larger one 16 pieces are read, evenly
    /// spread, so that a change of a few points may go unnoticed, but not another cloud.
    ///
    /// # Errors
    /// A cloud that cannot be read.
    pub fn content_sha256(&self, ids: &[String]) -> Result<String, DataError> {
        // Layouts with one table of labels for all frames: it is read once.
        let shared = match ids {
            [first, .., last] if self.has_labels() && self.labels_part(first)? == self.labels_part(last)? => {
                Some(files_sha256_bytes([self.labels_part(first)?])?)
            }
            _ => None,
        };
        let index = FrameIndex::of(self, ids.len());
        let of_frame = |id: &String| {
            let beside = shared.as_ref().map_or_else(|| index.labels(id), |labels| Ok(*labels))?;
            Ok(format!("{id}\n{}\n{}\n", hex(&index.cloud(id)?), hex(&beside)))
        };
        let mut hash = Sha256::new();
        for some in ids.chunks(AT_ONCE) {
            let frames: Vec<Result<String, DataError>> = some.par_iter().map(of_frame).collect();
            for frame in frames {
                hash.update(frame?);
            }
        }
        index.finish(true);
        Ok(hex(&hash.finalize()))
    }
}

/// Hash of the size and of pieces of a cloud.
pub(crate) fn cloud_sha256(part: &FilePart) -> Result<[u8; 32], DataError> {
    let mut file = part.open()?;
    let length = file.length();
    let mut hash = Sha256::new();
    hash.update(length.to_le_bytes());
    let mut piece = Vec::new();
    if length <= PIECES * PIECE_BYTES {
        file.read_to_end(&mut piece)?;
        hash.update(&piece);
        return Ok(hash.finalize().into());
    }
    for i in 0..PIECES {
        let at = (length - PIECE_BYTES) as u128 * u128::from(i) / u128::from(PIECES - 1);
        file.seek(at as u64)?;
        piece.clear();
        file.by_ref().take(PIECE_BYTES).read_to_end(&mut piece)?;
        hash.update(&piece);
    }
    Ok(hash.finalize().into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Cloud, Frame, Layout};

    #[test]
    fn changes_of_clouds_and_labels_are_seen() {
        let folder = tempfile::tempdir().unwrap();
        for id in ["a", "b"] {
            let cloud = Cloud { values: vec![1.0; 80_000], channels: 4 };
            Layout::Kitti.write_frame(folder.path(), &Frame { id: id.into(), cloud, objects: vec![] }).unwrap();
        }
        let ids = ["a", "b"].map(String::from);
        let now = || Dataset::open(folder.path()).unwrap().content_sha256(&ids).unwrap();
        let first = now();
        assert_eq!(now(), first);
        let (cloud, labels) = (folder.path().join("velodyne/b.bin"), folder.path().join("label_2/a.txt"));
        let bytes = std::fs::read(&cloud).unwrap();
        std::fs::write(&cloud, &bytes[16..]).unwrap();
        let shorter = now();
        std::fs::write(&cloud, [&bytes[..bytes.len() - 4], &2.0f32.to_le_bytes()].concat()).unwrap();
        let changed = now();
        std::fs::write(&cloud, bytes).unwrap();
        assert_eq!(now(), first);
        std::fs::write(labels, "Car 0 0 0 0 0 0 0 1.5 1.6 3.9 5 0 -1 0\n").unwrap();
        assert!([shorter, changed, now()].iter().all(|other| *other != first));
    }

    #[test]
    fn one_table_of_labels_for_all_frames_counts() {
        let folder = tempfile::tempdir().unwrap();
        for id in ["0", "1"] {
            let cloud = Cloud { values: vec![1.0; 8], channels: 4 };
            crate::write::write_bin(&folder.path().join(format!("velodyne/{id}.bin")), &cloud).unwrap();
        }
        let table = |yaw: f64| format!("frame,track,class,cx,cy,cz,l,w,h,yaw\n0,1,Car,9,1,0,4,2,2,{yaw}\n");
        let now = |yaw: f64| {
            std::fs::write(folder.path().join("labels.csv"), table(yaw)).unwrap();
            Dataset::open(folder.path()).unwrap().content_sha256(&["0", "1"].map(String::from)).unwrap()
        };
        assert!(now(0.1) == now(0.1) && now(0.1) != now(0.2));
    }
}
