//! Writes frames in shards: tar files of many frames each.

use super::{Content, Conversion, ConvertManifest};
use crate::checksum::hex;
use crate::layout::shards::{FOLDER, ShardFrame, remove_other_shards, shard_name, write_index, write_shard};
use crate::{DataError, NewDataset, to_kitti_text};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::sync::atomic::{AtomicUsize, Ordering};

/// What was read of the frames of a shard.
#[derive(Default)]
struct Tally {
    hash: Sha256,
    points: usize,
    labels: usize,
}

impl Tally {
    fn add(&mut self, id: &str, content: &Content) {
        self.hash.update(format!("{id}\n{}\n", content.sha256()));
        self.points += content.cloud.len();
        self.labels += content.labels.len();
    }

    fn finish(self) -> (String, [usize; 2]) {
        (hex(&self.hash.finalize()), [self.points, self.labels])
    }
}

/// Writes all shards and their index; returns the names of their records.
pub(super) fn write(
    conversion: &Conversion,
    new: &NewDataset,
    ids: &[String],
    progress: &(dyn Fn(usize, usize) + Sync),
    manifest: &mut ConvertManifest,
) -> Result<Vec<String>, DataError> {
    let folder = new.root().join(FOLDER);
    let shards: Vec<&[String]> = ids.chunks(conversion.shard_frames.max(1)).collect();
    remove_other_shards(&folder, shards.len())?;
    let labelled = conversion.dataset.has_labels();
    let done = AtomicUsize::new(0);
    progress(0, ids.len());
    let write_one = |(number, ids): (usize, &&[String])| {
        let name = shard_name(number);
        let path = folder.join(&name);
        let read = || {
            let mut tally = Tally::default();
            for id in *ids {
                tally.add(id, &conversion.content(id)?);
            }
            Ok::<_, DataError>(tally.finish())
        };
        let make = || {
            let mut tally = Tally::default();
            let frames = ids.iter().map(|id| {
                let content = conversion.content(id)?;
                tally.add(id, &content);
                let labels = labelled.then(|| to_kitti_text(&content.labels));
                let cloud = content.cloud.values.iter().flat_map(|v| v.to_le_bytes()).collect();
                Ok(ShardFrame { id: id.clone(), cloud, labels })
            });
            write_shard(&path, frames)?;
            Ok::<_, DataError>(tally.finish())
        };
        let counts = new.file_of_frames(&name, &path, read, make)?;
        progress(done.fetch_add(ids.len(), Ordering::Relaxed) + ids.len(), manifest.frames);
        Ok((name, counts))
    };
    let written: Vec<Result<(String, [usize; 2]), DataError>> = shards.par_iter().enumerate().map(write_one).collect();
    let mut names = Vec::with_capacity(written.len());
    for shard in written {
        let (name, [points, labels]) = shard?;
        names.push(name);
        manifest.points += points;
        manifest.labels += labels;
    }
    write_index(&folder)?;
    conversion.describe(new, &|id| id.to_owned())?;
    Ok(names)
}
