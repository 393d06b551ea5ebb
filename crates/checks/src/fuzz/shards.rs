//! The readers of shards: tar files with frames, and their index.

use super::targets::Target;
use anyhow::{Context, Result};
use data::convert::{Conversion, Format};
use data::{Cloud, Dataset, Frame, Layout};
use std::cell::Cell;
use std::path::{Path, PathBuf};

/// A shard of three frames, and its index, each damaged separately.
pub(super) fn targets(folder: &Path) -> Result<Vec<Target>> {
    let (kitti, made) = (folder.join("shards-source"), folder.join("shards-made"));
    let mut clouds = Vec::new();
    for (i, id) in ["a", "b", "c"].into_iter().enumerate() {
        let cloud = Cloud { values: (0..40 + 4 * i).map(|v| v as f32).collect(), channels: 4 };
        clouds.push((id, cloud.clone()));
        Layout::Kitti.write_frame(&kitti, &Frame { id: id.into(), cloud, objects: Vec::new() })?;
    }
    let source = Dataset::open(&kitti)?;
    Conversion { dataset: &source, to: Format::Shards, shard_frames: 3 }.make(&made, &|_, _| ())?;
    let inside = made.join("shards");
    let shard = fs_err::read(inside.join("shard-000000.tar"))?;
    let index = fs_err::read(inside.join("index.jsonl")).context("the index of the shards")?;

    // A file of another name is read anew, even if its size and its time are those of the one before.
    let number = Cell::new(0);
    let lone: PathBuf = folder.join("shards-lone");
    fs_err::create_dir_all(&lone)?;
    let of_shard = {
        let lone = lone.clone();
        move |bytes: &[u8]| {
            fs_err::remove_file(lone.join(format!("{}.tar", number.get()))).ok();
            number.set(number.get() + 1);
            fs_err::write(lone.join(format!("{}.tar", number.get())), bytes).map_err(|e| e.to_string())?;
            let Ok(set) = Dataset::open(&lone) else { return Ok(false) };
            let ids = set.all_ids().map_err(|e| format!("an index without frames: {e}"))?;
            let mut read = ids.iter().filter_map(|id| set.load(id).ok());
            let near = |frame: Frame| frame.cloud.values.iter().all(|v| v.is_finite()) && !frame.cloud.is_empty();
            if read.all(near) { Ok(true) } else { Err("a cloud that is not valid".into()) }
        }
    };
    let lone = folder.join("shards-index");
    fs_err::create_dir_all(&lone)?;
    let (number, whole) = (Cell::new(0), shard.clone());
    let of_index = move |bytes: &[u8]| {
        // The index names this shard, which has to be read anew.
        let folder = lone.join(number.get().to_string());
        fs_err::remove_dir_all(&folder).ok();
        number.set(number.get() + 1);
        let folder = lone.join(number.get().to_string());
        fs_err::create_dir_all(&folder).map_err(|e| e.to_string())?;
        fs_err::write(folder.join("shard-000000.tar"), &whole).map_err(|e| e.to_string())?;
        fs_err::write(folder.join("index.jsonl"), bytes).map_err(|e| e.to_string())?;
        let Ok(set) = Dataset::open(&folder) else { return Ok(false) };
        let right = |(id, cloud): &(&str, Cloud)| !matches!(set.load_cloud(id), Ok(found) if found != *cloud);
        if clouds.iter().all(right) { Ok(true) } else { Err("another cloud than that of the frame".into()) }
    };
    Ok(vec![
        Target { name: "shard", valid: shard, read: Box::new(of_shard) },
        Target { name: "shard index", valid: index, read: Box::new(of_index) },
    ])
}
