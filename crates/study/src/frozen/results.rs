//! OpenPCDet's `result.pkl` on the frames of a data set.

use crate::error::Result;
use data::{DataError, Dataset, Detection};
use eval::EvalFrame;
use models::results::read_results;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// The detections of a `result.pkl` by the ids of a data set, in the LiDAR frame. Ids of the file may lack leading
/// zeros.
///
/// # Errors
/// As [`read_results`], and a frame that occurs twice.
pub(super) fn results_by_frame(path: &Path, dataset: &Dataset) -> Result<BTreeMap<String, Vec<Detection>>> {
    let own = OwnIds::new(dataset.all_ids()?);
    let mut found: BTreeMap<String, Vec<Detection>> = BTreeMap::new();
    for frame in read_results(path)? {
        let id = own.own(&frame.frame_id);
        if found.insert(id.clone(), frame.detections).is_some() {
            return Err(DataError::file(path, format!("frame {id} occurs twice")).into());
        }
    }
    Ok(found)
}

/// Frames of a data set with its labels and the detections of a `result.pkl`, in the label frame of the data set.
///
/// # Errors
/// As [`read_results`], and a frame that the file does not have.
pub fn read_result_frames(path: &Path, dataset: &Dataset, ids: &[String]) -> Result<Vec<EvalFrame>> {
    let found = results_by_frame(path, dataset)?;
    let missing: Vec<&String> = ids.iter().filter(|id| !found.contains_key(*id)).collect();
    if let Some(first) = missing.first() {
        let (without, all) = (missing.len(), ids.len());
        let message = format!(
            "has no frame {first}; {without} of {all} frames have no entry. A frame without detections has one with \
             empty arrays"
        );
        return Err(DataError::file(path, message).into());
    }
    let read = |id: &String| {
        let detections = dataset.detection_boxes(id, &found[id])?;
        Ok(EvalFrame { id: id.clone(), labels: dataset.labels(id)?, detections })
    };
    // Collects all results first, so that the first bad frame is reported for any number of threads.
    let frames: Vec<Result<EvalFrame, DataError>> = ids.par_iter().map(read).collect();
    Ok(frames.into_iter().collect::<Result<_, _>>()?)
}

/// The ids of a data set, found from ids that may lack leading zeros.
struct OwnIds {
    ids: BTreeSet<String>,
    /// By the id without leading zeros; `None` if several ids are the same number.
    by_number: BTreeMap<String, Option<String>>,
}

impl OwnIds {
    fn new(ids: Vec<String>) -> Self {
        let mut by_number: BTreeMap<String, Option<String>> = BTreeMap::new();
        for id in &ids {
            by_number.entry(number(id)).and_modify(|known| *known = None).or_insert_with(|| Some(id.clone()));
        }
        OwnIds { ids: ids.into_iter().collect(), by_number }
    }

    /// The id of the data set; unchanged if it has no such frame.
    fn own(&self, id: &str) -> String {
        let is_number = !id.is_empty() && id.bytes().all(|b| b.is_ascii_digit());
        if self.ids.contains(id) || !is_number {
            return id.into();
        }
        self.by_number.get(&number(id)).cloned().flatten().unwrap_or_else(|| id.into())
    }
}

fn number(id: &str) -> String {
    let short = id.trim_start_matches('0');
    if short.is_empty() && !id.is_empty() { "0".into() } else { short.into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_without_leading_zeros_are_found() {
        let own = OwnIds::new(["000000", "000007", "07x", "8", "08"].map(String::from).into());
        for (id, wanted) in
            [("7", "000007"), ("0", "000000"), ("000007", "000007"), ("07x", "07x"), ("7x", "7x"), ("9", "9")]
        {
            assert_eq!(own.own(id), wanted);
        }
        assert_eq!(own.own("008"), "008", "8 and 08 are the same number");
    }
}
