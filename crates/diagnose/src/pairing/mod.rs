//! Pairing of two data sets of the same scenes, return by return.

mod alone;
mod boxes;
mod frame;
mod gaps;
mod identical;
mod matching;
mod of_sensor;
mod prediction;
mod ray;
mod recordings;
mod roughness;
mod row_edges;
mod second;

pub use alone::{FrameAlone, frame_alone};
pub use boxes::{BoxShift, SurfacePoint, fit_shift};
pub use frame::{Corrections, FramePair, ObjectPair, RangeError, RecordedFrame, ShownShift, pair_frame};
pub(crate) use frame::{alone, round_ranges};
pub use gaps::{gap_margin_m, mixed_per_rad};
pub use identical::{Identity, check_identity, met_squarely};
pub use matching::{Matched, match_directions};
pub use of_sensor::company_m;
pub use prediction::at_object;
pub use ray::{Lies, OCTANTS, Ray, Surface};
pub(crate) use recordings::load;
pub use recordings::{PairSide, Recordings, SideFrame};
pub use roughness::STRAY_M;
pub use row_edges::{JUMPS, Jumps, LEVEL, RowEdges, jump_m};

use crate::error::DiagnoseError;
use data::Dataset;
use rand::RngExt;
use rayon::prelude::*;
use sensor::Rig;
use sensor::directions::{SensorScan, Sensors};
use std::collections::BTreeSet;
use std::io::{Read, Seek, SeekFrom};

/// Returns that are kept of each side over all frames. More do not improve findings, and memory stays bounded: 200
/// frames of 75,000 shots have to fit into 4 GiB.
const KEPT: usize = 2_500_000;

/// Frames that the scan patterns are estimated from.
const PATTERN_FRAMES: usize = 10;

/// Whether a cloud holds no point: it is empty, or a PCD whose header says so.
pub(crate) fn has_no_point(set: &Dataset, id: &str) -> Result<bool, DiagnoseError> {
    let part = set.cloud_part(id)?;
    let (start, length) = part.range.unwrap_or((0, u64::MAX));
    let mut file = fs_err::File::open(&part.path)?;
    file.seek(SeekFrom::Start(start))?;
    let mut head = Vec::new();
    file.take(length.min(2000)).read_to_end(&mut head)?;
    let pcd = set.cloud_path(id).extension().is_some_and(|e| e.eq_ignore_ascii_case("pcd"));
    let says_so = |line: &str| line.split_whitespace().eq(["POINTS", "0"]);
    Ok(head.is_empty() || pcd && String::from_utf8_lossy(&head).lines().any(says_so))
}

/// The frames of which both sides have points, and notes about the others.
pub fn with_points(
    measured: &Dataset,
    simulated: &Dataset,
    ids: Vec<String>,
) -> Result<(Vec<String>, Vec<String>), DiagnoseError> {
    let (mut kept, mut notes) = (Vec::new(), Vec::new());
    for id in ids {
        let empty = [("measured", measured), ("simulated", simulated)]
            .into_iter()
            .map(|(name, side)| Ok((name, has_no_point(side, &id)?)))
            .collect::<Result<Vec<_>, DiagnoseError>>()?;
        match empty.iter().find(|e| e.1) {
            Some((name, _)) => notes.push(format!("frame {id}: the {name} cloud has no point; left out")),
            None => kept.push(id),
        }
    }
    // A side without any point makes one note, not one for each frame.
    const LISTED: usize = 8;
    if notes.len() > LISTED {
        let more = notes.len() - LISTED;
        notes.truncate(LISTED);
        notes.push(format!("and {more} more frames without a point on one side"));
    }
    Ok((kept, notes))
}

/// Ids that both sides have, in order, and notes about the others.
pub fn common_ids(
    measured: &Dataset,
    simulated: &Dataset,
    split: Option<&str>,
) -> Result<(Vec<String>, Vec<String>), DiagnoseError> {
    let (a, b) = (measured.ids_of(split)?, simulated.ids_of(split)?);
    let in_b: BTreeSet<&String> = b.iter().collect();
    let mut common: Vec<String> = a.iter().filter(|id| in_b.contains(id)).cloned().collect();
    common.sort();
    common.dedup();
    if common.is_empty() {
        let show = |ids: &[String]| ids.first().cloned().unwrap_or_default();
        return Err(DiagnoseError::Pair(format!(
            "no frame id is in both data sets: {} has {} frames ({}, ...), {} has {} ({}, ...). If they show different streets, give --unpaired",
            measured.config.root.display(),
            a.len(),
            show(&a),
            simulated.config.root.display(),
            b.len(),
            show(&b),
        )));
    }
    let mut notes = Vec::new();
    for (name, ids) in [("measured", &a), ("simulated", &b)] {
        let alone = ids.iter().collect::<BTreeSet<_>>().len() - common.len();
        if alone > 0 {
            notes.push(format!("{alone} frames are only in the {name} data set and were left out"));
        }
    }
    Ok((common, notes))
}

/// Scan patterns from some frames of both sides.
pub fn find_sensors(recordings: &Recordings, rig: &Rig) -> Result<Sensors, DiagnoseError> {
    let step = recordings.len().div_ceil(PATTERN_FRAMES).max(1);
    let some: Vec<usize> = (0..recordings.len()).step_by(step).collect();
    let sides = some
        .par_iter()
        .flat_map_iter(|&i| [PairSide::Measured, PairSide::Simulated].map(|side| recordings.side(i, side)));
    let sides: Vec<&SideFrame> = in_order(sides)?;
    let scans: Vec<&[SensorScan]> = sides.iter().map(|s| &s.scans[..]).collect();
    Ok(Sensors::find(rig, &scans))
}

/// Returns that are kept of each side of a frame, of so many frames.
pub fn kept_of_frame(frames: usize) -> usize {
    (KEPT / frames.max(1)).max(500)
}

/// Pairs all frames; compares at most about `kept` returns of each side of a frame, the same share of both. `done`
/// receives the number of frames finished so far.
pub fn pair_all(
    recordings: &Recordings,
    sensors: &Sensors,
    corrections: Corrections,
    kept: usize,
    done: &(dyn Fn(usize) + Sync),
) -> Result<Vec<FramePair>, DiagnoseError> {
    let finished = std::sync::atomic::AtomicUsize::new(0);
    in_order((0..recordings.len()).into_par_iter().map(|i| {
        let recorded = RecordedFrame {
            number: i,
            id: recordings.id(i),
            measured: recordings.side(i, PairSide::Measured)?,
            simulated: recordings.side(i, PairSide::Simulated)?,
            matched: recordings.matched(i, sensors)?,
            edges: recordings.edges(i, sensors)?,
        };
        let frame = pair_frame(&recorded, sensors, corrections, kept);
        done(finished.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1);
        Ok(frame)
    }))
}

/// Results in order. The first error in that order is returned, whatever the number of threads.
pub(crate) fn in_order<T: Send>(
    results: impl ParallelIterator<Item = Result<T, DiagnoseError>>,
) -> Result<Vec<T>, DiagnoseError> {
    results.collect::<Vec<_>>().into_iter().collect()
}

/// Keeps about `kept` of the rays, chosen at random. `stream` is the number of the frame and one of the kind of rays.
pub(crate) fn thin(rays: &mut Vec<Ray>, kept: usize, stream: [u64; 2]) {
    let mut keeps = keeps(kept as f64 / rays.len().max(1) as f64, stream);
    rays.retain(|_| keeps());
    rays.shrink_to_fit();
}

/// Draws whether a ray is one of a share of them.
fn keeps(share: f64, [frame, kind]: [u64; 2]) -> impl FnMut() -> bool {
    let mut rng = data::stream(0, "diagnose thin", kind, frame);
    move || share >= 1.0 || rng.random::<f64>() < share
}
