//! Frames that are duplicates or nearly so. Duplicates across splits mean that an evaluation uses training data.

use super::ground::Ground;
use super::report::{Findings, at_most};
use super::survey::FrameFacts;
use crate::Cloud;
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// Side of a voxel, m. Large, so that noise of a few centimetres changes few occupied voxels.
const VOXEL_M: f64 = 0.5;
/// Largest distance of points that are compared, m. Farther voxels are occupied at random.
const MAX_DISTANCE_M: f64 = 40.0;
/// Number of smallest hashes kept of a frame (MinHash sketch).
const SKETCH: usize = 256;
/// Smallest number of occupied voxels of a frame that is compared.
const MIN_VOXELS: usize = 100;
/// Jaccard index of the occupied voxels from which two frames show the same scene. On KITTI different scenes have less
/// than 0.1. Copies of a scan have 0.9 with 5 cm of noise, 0.8 moved by 10 cm, 0.75 with half of the points.
const NEAR_DUPLICATE: f64 = 0.7;

/// Fingerprint of a frame: a hash of its exact values and a MinHash sketch of the voxels occupied above the ground.
pub(super) struct Signature {
    exact: [u8; 16],
    /// The smallest hashes of occupied voxels, ascending; empty if there are too few voxels. Of each the upper half, so
    /// that the sketches of a million frames fit into memory.
    sketch: Vec<u32>,
}

impl Signature {
    pub(super) fn of(cloud: &Cloud, ground: &Ground) -> Self {
        let mut hash = Sha256::new();
        for chunk in cloud.values.chunks(4096) {
            hash.update(chunk.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>());
        }
        let mut exact = [0; 16];
        exact.copy_from_slice(&hash.finalize()[..16]);
        let near = ground.standing().filter(|p| p[0].hypot(p[1]) < MAX_DISTANCE_M);
        let mut sketch: Vec<u32> =
            near.map(|p| (voxel_hash(p.map(|v| (v / VOXEL_M).floor() as i64)) >> 32) as u32).collect();
        sketch.sort_unstable();
        sketch.dedup();
        if sketch.len() < MIN_VOXELS {
            sketch.clear();
        }
        sketch.truncate(SKETCH);
        sketch.shrink_to_fit();
        Signature { exact, sketch }
    }
}

/// Hash of the three indices by splitmix64.
fn voxel_hash(voxel: [i64; 3]) -> u64 {
    voxel.into_iter().fold(0x9E37_79B9_7F4A_7C15, |hash: u64, v| {
        let mut z = (hash ^ v as u64).wrapping_add(0x9E37_79B9_7F4A_7C15);
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    })
}

/// Estimated Jaccard index of two sets from their MinHash sketches: the fraction of the smallest hashes of the union
/// that both sets have.
fn jaccard(a: &[u32], b: &[u32]) -> f64 {
    let (mut i, mut j, mut seen, mut shared) = (0, 0, 0, 0);
    let size = a.len().min(b.len());
    while seen < size && i < a.len() && j < b.len() {
        let both = a[i] == b[j];
        shared += usize::from(both);
        (i, j) = (i + usize::from(a[i] <= b[j]), j + usize::from(b[j] < a[i] || both));
        seen += 1;
    }
    if size == 0 { 0.0 } else { shared as f64 / size as f64 }
}

/// Largest distance between the centres of an object in two frames of the same scene, m.
const SAME_PLACE_M: f64 = 1.0;

/// Whether the labelled objects of two frames are at the same places. Background alone is not enough: it looks alike on
/// straight roads and on every lap of a race track. Frames without objects agree.
fn objects_agree(a: &FrameFacts, b: &FrameFacts) -> bool {
    let near =
        |p: &[f64; 3], q: &[f64; 3]| p.iter().zip(q).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt() <= SAME_PLACE_M;
    a.objects.len() == b.objects.len()
        && a.objects.iter().all(|o| b.objects.iter().any(|p| near(&o.bbox.center, &p.bbox.center)))
}

/// Which splits have which frames.
struct Membership<'a> {
    /// The sets of splits that frames are in; the first one is empty.
    sets: Vec<BTreeSet<&'a str>>,
    /// The set of each frame, an index.
    set_of: Vec<usize>,
}

impl<'a> Membership<'a> {
    fn of(frames: &[FrameFacts], split_of: &HashMap<&'a str, BTreeSet<&'a str>>) -> Self {
        let mut sets = vec![BTreeSet::new()];
        let set_of = frames.iter().map(|frame| {
            let Some(own) = split_of.get(frame.id.as_str()) else { return 0 };
            sets.iter().position(|set| set == own).unwrap_or_else(|| {
                sets.push(own.clone());
                sets.len() - 1
            })
        });
        let set_of = set_of.collect();
        Membership { sets, set_of }
    }

    fn splits_of(&self, i: usize) -> &BTreeSet<&'a str> {
        &self.sets[self.set_of[i]]
    }

    /// Whether two frames are in different splits: no split has both.
    fn differs(&self, i: usize, j: usize) -> bool {
        let (a, b) = (self.splits_of(i), self.splits_of(j));
        !a.is_empty() && !b.is_empty() && a.is_disjoint(b)
    }
}

/// Number of frames with one hash, one number of objects and one set of splits that others are compared with. In data
/// of a sensor that does not move all frames share hashes, and the time would grow with the square of their number.
const MOST_CANDIDATES: usize = 32;

/// Pairs of frames in different splits that show nearly the same scene: of each frame the first such frame before it.
///
/// Frames that share most voxels share most of their smallest hashes: candidates share one of the first eight.
fn near_duplicates(frames: &[FrameFacts], membership: &Membership) -> Vec<(usize, usize)> {
    let first = |j: usize| &frames[j].signature.sketch[..frames[j].signature.sketch.len().min(8)];
    let mut by_hash: HashMap<(u32, usize, usize), Vec<usize>> = HashMap::new();
    for (j, frame) in frames.iter().enumerate().filter(|(j, _)| membership.set_of[*j] != 0) {
        for hash in first(j) {
            let alike = by_hash.entry((*hash, frame.objects.len(), membership.set_of[j])).or_default();
            if alike.len() < MOST_CANDIDATES {
                alike.push(j);
            }
        }
    }
    let of_frame = |j: usize| {
        let frame = &frames[j];
        let others = (1..membership.sets.len()).filter(|set| {
            let (own, other) = (membership.splits_of(j), &membership.sets[*set]);
            !own.is_empty() && own.is_disjoint(other)
        });
        let keys = others.flat_map(|set| first(j).iter().map(move |hash| (*hash, frame.objects.len(), set)));
        let candidates: BTreeSet<usize> = keys.filter_map(|key| by_hash.get(&key)).flatten().copied().collect();
        let alike = |i: &usize| {
            let (a, b) = (&frames[*i].signature, &frame.signature);
            a.exact != b.exact && objects_agree(&frames[*i], frame) && jaccard(&a.sketch, &b.sketch) >= NEAR_DUPLICATE
        };
        candidates.range(..j).copied().find(alike).map(|i| (i, j))
    };
    (0..frames.len()).into_par_iter().filter_map(of_frame).collect()
}

pub(super) fn compare(frames: &[FrameFacts], splits: &BTreeMap<String, Vec<String>>, findings: &mut Findings) {
    let mut split_of: HashMap<&str, BTreeSet<&str>> = HashMap::new();
    for (split, ids) in splits {
        ids.iter().for_each(|id| _ = split_of.entry(id).or_default().insert(split));
    }
    let mut in_two: Vec<_> =
        split_of.iter().filter(|(_, splits)| splits.len() > 1).map(|(id, _)| id.to_string()).collect();
    in_two.sort_unstable();
    if !in_two.is_empty() {
        let message = format!("{} frames are in more than one split: {}", in_two.len(), at_most(5, &in_two, ", "));
        findings.problem("duplicates", message, in_two);
    }

    let membership = Membership::of(frames, &split_of);
    let name = |i: usize, j: usize| {
        let named = |i: usize| match membership.splits_of(i).first() {
            Some(split) => format!("{} ({split})", frames[i].id),
            None => frames[i].id.clone(),
        };
        format!("{} and {}", named(i), named(j))
    };
    let (mut across, mut within) = (Vec::new(), Vec::new());
    // The first frame with a cloud, and the first one of each set of splits.
    let mut by_exact: HashMap<[u8; 16], Vec<usize>> = HashMap::new();
    for (j, frame) in frames.iter().enumerate() {
        let same = by_exact.entry(frame.signature.exact).or_default();
        if let Some(i) = same.iter().copied().find(|i| membership.differs(*i, j)) {
            across.push((i, j));
        } else if let Some(i) = same.first() {
            within.push((*i, j));
        }
        if same.iter().all(|i| membership.set_of[*i] != membership.set_of[j]) {
            same.push(j);
        }
    }
    let near = near_duplicates(frames, &membership);
    let mut report = |pairs: Vec<(usize, usize)>, problem: bool, what: &str| {
        if !pairs.is_empty() {
            let names: Vec<_> = pairs.iter().map(|(i, j)| name(*i, *j)).collect();
            let message = format!("{} frames {what}: {}", pairs.len(), at_most(5, &names, ", "));
            let ids = pairs.into_iter().flat_map(|(i, j)| [frames[i].id.clone(), frames[j].id.clone()]);
            let severity = if problem { super::Severity::Problem } else { super::Severity::Note };
            findings.add(severity, "duplicates", message, ids);
        }
    };
    report(across, true, "have exactly the cloud of a frame of another split");
    report(near, true, "show nearly the same scene as a frame of another split");
    report(within, false, "have exactly the cloud of another frame");
}
