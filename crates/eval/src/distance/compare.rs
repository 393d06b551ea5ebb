//! Distances between two data sets, frame by frame.

use super::frames::{FrameDistances, by_frame};
use super::part::select;
use super::regions::RegionSums;
use super::{Chamfer, DistanceError, Part, Point, RegionRow, Regions, emd, nearest, sinkhorn, sliced_wasserstein};
use crate::{BootstrapOptions, Interval, RangeSection};
use data::{Frame, stream};
use rand::seq::SliceRandom;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use statistics::{deviation, mean};
use std::collections::BTreeSet;
use std::fmt;

/// Schema version of [`Distances`] as JSON.
pub const DISTANCES_SCHEMA: &str = "lidarshift.distances/2";

/// Edge length of the cells used to split a cloud into halves for the noise floor, m.
pub const FLOOR_CELL_M: f64 = 4.0;

/// A distance measure.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Measure {
    /// [`Chamfer::sum_m2`], the paper's CD.
    ChamferSumM2,
    /// [`Chamfer::mean_m2`].
    ChamferMeanM2,
    /// [`Chamfer::a_to_b_m2`].
    ChamferAToBM2,
    /// [`Chamfer::b_to_a_m2`].
    ChamferBToAM2,
    /// [`Chamfer::mean_m`].
    ChamferMeanM,
    /// [`Chamfer::density_aware`].
    ChamferDensityAware,
    /// [`emd`] of subsamples, the paper's EMD.
    EmdM,
    /// [`sinkhorn`] of subsamples.
    SinkhornM,
    /// [`sliced_wasserstein`].
    SlicedWassersteinM,
}

impl Measure {
    /// In table order.
    pub const ALL: [Measure; 9] = [
        Measure::ChamferSumM2,
        Measure::ChamferMeanM2,
        Measure::ChamferAToBM2,
        Measure::ChamferBToAM2,
        Measure::ChamferMeanM,
        Measure::ChamferDensityAware,
        Measure::EmdM,
        Measure::SinkhornM,
        Measure::SlicedWassersteinM,
    ];
}

impl fmt::Display for Measure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Measure::ChamferSumM2 => "Chamfer, sum (m²)",
            Measure::ChamferMeanM2 => "Chamfer, mean per point (m²)",
            Measure::ChamferAToBM2 => "Chamfer, A to B (m²)",
            Measure::ChamferBToAM2 => "Chamfer, B to A (m²)",
            Measure::ChamferMeanM => "Chamfer, not squared (m)",
            Measure::ChamferDensityAware => "Chamfer, density-aware",
            Measure::EmdM => "EMD, exact (m)",
            Measure::SinkhornM => "EMD, Sinkhorn (m)",
            Measure::SlicedWassersteinM => "Sliced Wasserstein (m)",
        })
    }
}

/// The processing stage at which clouds are compared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Compared {
    /// As stored in the data set.
    #[default]
    Raw,
    /// Output of the training loader before augmentation: cropped to the detector's range.
    Loader,
    /// Network input during training: the same after augmentation.
    Augmented,
}

impl fmt::Display for Compared {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Compared::Raw => "raw clouds",
            Compared::Loader => "the training loader's clouds before augmentation",
            Compared::Augmented => "the training loader's clouds after augmentation",
        })
    }
}

/// Settings of the comparison.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DistanceOptions {
    /// Processing stage of the clouds; every table states it.
    pub compared: Compared,
    /// Points farther away on the ground plane are excluded, m.
    pub max_range_m: f64,
    /// Range sections reported in addition to the whole cloud and the targets.
    pub sections: Vec<RangeSection>,
    /// Points per cloud for the exact assignment. If one cloud has fewer, both use that number.
    pub emd_points: usize,
    /// Points per cloud for the Sinkhorn iteration.
    pub sinkhorn_points: usize,
    /// Entropic regularisation of the Sinkhorn iteration, m.
    pub sinkhorn_epsilon_m: f64,
    /// Maximum number of Sinkhorn iterations.
    pub sinkhorn_iterations: usize,
    /// Number of projection directions of the sliced Wasserstein distance.
    pub directions: usize,
    /// Seed of subsamples and directions.
    pub seed: u64,
    /// Bootstrap settings for intervals over the frames.
    pub bootstrap: BootstrapOptions,
}

impl Default for DistanceOptions {
    fn default() -> Self {
        DistanceOptions {
            compared: Compared::Raw,
            max_range_m: 100.0,
            sections: RangeSection::PAPER.into(),
            emd_points: 512,
            sinkhorn_points: 512,
            sinkhorn_epsilon_m: 0.1,
            sinkhorn_iterations: 200,
            directions: 64,
            seed: 0,
            bootstrap: BootstrapOptions::default(),
        }
    }
}

/// One measure on one part, over all frames.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MeasureRow {
    /// Subset of points.
    pub part: Part,
    /// Distance measure.
    pub measure: Measure,
    /// Frame pairs in which both clouds have such points.
    pub frames: usize,
    /// Frame pairs in which one cloud has none.
    pub left_out: usize,
    /// Mean over the frame pairs; `None` without pairs.
    pub mean: Option<f64>,
    /// Standard deviation over the frame pairs, divisor n.
    pub deviation: Option<f64>,
    /// Bootstrap interval of the mean over the frame pairs.
    pub interval: Option<Interval>,
    /// Noise floor: the distance between two random halves of A's own cloud. Points are split per cell of
    /// [`FLOOR_CELL_M`], so that neither half loses an object entirely; the odd point of a cell goes into both halves.
    /// [`Measure::EmdM`] and [`Measure::SinkhornM`] use subsamples of the halves. Smaller distances are not
    /// significant. Halves are sparser than the cloud, so for Chamfer distances of dense clouds this is an upper
    /// bound.
    pub floor: Option<f64>,
}

/// Distances between two data sets.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Distances {
    /// [`DISTANCES_SCHEMA`].
    pub schema: String,
    /// Name of the first data set.
    pub a: String,
    /// Name of the second data set.
    pub b: String,
    /// Settings used.
    pub options: DistanceOptions,
    /// Number of frame pairs.
    pub frames: usize,
    /// By part, then by measure.
    pub rows: Vec<MeasureRow>,
    /// Contribution of each region to the Chamfer sum of the whole cloud; empty without regions.
    pub regions: Vec<RegionRow>,
}

/// The frame ids that both data sets have, in the order of the first.
///
/// # Errors
/// An id that only one data set has: both must hold the same moments.
pub fn paired_ids(a: &[String], b: &[String]) -> Result<Vec<String>, DistanceError> {
    let (in_a, in_b): (BTreeSet<&String>, BTreeSet<&String>) = (a.iter().collect(), b.iter().collect());
    let only_a = in_a.difference(&in_b).count();
    let only_b = in_b.difference(&in_a).count();
    if only_a + only_b > 0 {
        let first = in_a.symmetric_difference(&in_b).next().map(|id| id.as_str()).unwrap_or_default();
        return Err(DistanceError::Pairing(format!(
            "{only_a} of {} frames are only in the first and {only_b} of {} only in the second ({first} for one); \
             compare splits of the same frames",
            a.len(),
            b.len()
        )));
    }
    Ok(a.to_vec())
}

/// Compares two data sets frame by frame. `load` returns both frames of an id; `names` are the data set names. The
/// result does not depend on the number of threads.
///
/// # Errors
/// A frame that cannot be read, or a non-finite position.
pub fn compare(
    names: [&str; 2],
    ids: &[String],
    load: impl Fn(&str) -> Result<[Frame; 2], DistanceError> + Sync,
    regions: Option<&Regions>,
    options: &DistanceOptions,
) -> Result<Distances, DistanceError> {
    compare_by_frame(names, ids, load, regions, options).map(|(distances, _)| distances)
}

/// As [`compare`], with the distances of every frame.
///
/// # Errors
/// As [`compare`].
pub fn compare_by_frame(
    names: [&str; 2],
    ids: &[String],
    load: impl Fn(&str) -> Result<[Frame; 2], DistanceError> + Sync,
    regions: Option<&Regions>,
    options: &DistanceOptions,
) -> Result<(Distances, Vec<FrameDistances>), DistanceError> {
    let parts: Vec<Part> =
        [Part::Whole, Part::Targets].into_iter().chain(options.sections.iter().copied().map(Part::Section)).collect();
    let of_id = |(i, id): (usize, &String)| {
        let frames = load(id)?;
        let mut values = Vec::with_capacity(parts.len());
        let mut sums = RegionSums::default();
        for part in &parts {
            let [a, b] = [&frames[0], &frames[1]].map(|frame| select(frame, *part, options.max_range_m));
            if a.is_empty() || b.is_empty() {
                values.push(None);
                continue;
            }
            let (forth, back) = (nearest(&a, &b)?, nearest(&b, &a)?);
            if let (Part::Whole, Some(regions)) = (part, regions) {
                let (of_a, of_b) = ((regions.of)(&frames[0], &a), (regions.of)(&frames[1], &b));
                sums = RegionSums::new(regions.names.len(), [(&of_a, &forth), (&of_b, &back)]);
            }
            let distance = measures(&Chamfer::of_nearest(&forth, &back), &a, &b, i, options)?;
            values.push(Some((distance, floor(&a, i, options)?)));
        }
        Ok((values, sums))
    };
    let found: Vec<Result<_, DistanceError>> = ids.par_iter().enumerate().map(of_id).collect();
    let found: Vec<_> = found.into_iter().collect::<Result<_, _>>()?;

    let mut rows = Vec::new();
    for (k, part) in parts.iter().enumerate() {
        let of_part: Vec<_> = found.iter().filter_map(|(values, _)| values[k].as_ref()).collect();
        for (m, measure) in Measure::ALL.into_iter().enumerate() {
            let values: Vec<f64> = of_part.iter().map(|(distance, _)| distance[m]).collect();
            let floors: Vec<f64> = of_part.iter().filter_map(|(_, floor)| Some(floor.as_ref()?[m])).collect();
            let known = |values: &[f64], v: f64| (!values.is_empty()).then_some(v);
            rows.push(MeasureRow {
                part: *part,
                measure,
                frames: values.len(),
                left_out: found.len() - values.len(),
                mean: known(&values, mean(&values)),
                deviation: known(&values, deviation(&values)),
                interval: interval(&values, &options.bootstrap),
                floor: known(&floors, mean(&floors)),
            });
        }
    }
    let mut sums = RegionSums::default();
    found.iter().for_each(|(_, of_frame)| sums.add(of_frame));
    let values: Vec<Vec<_>> =
        found.iter().map(|(parts, _)| parts.iter().map(|part| part.as_ref().map(|(d, _)| *d)).collect()).collect();
    let by_frame = by_frame(&rows, &values);
    let distances = Distances {
        schema: DISTANCES_SCHEMA.into(),
        a: names[0].into(),
        b: names[1].into(),
        options: options.clone(),
        frames: ids.len(),
        rows,
        regions: regions.map_or(Vec::new(), |regions| sums.rows(&regions.names)),
    };
    Ok((distances, by_frame))
}

fn interval(values: &[f64], bootstrap: &BootstrapOptions) -> Option<Interval> {
    if values.len() < 2 {
        return None;
    }
    let draw = |r: usize| {
        let weights = bootstrap.frame_weights("distances", r, values.len());
        values.iter().zip(weights).map(|(v, n)| v * f64::from(n)).sum::<f64>() / values.len() as f64
    };
    bootstrap.interval((0..bootstrap.replicates).map(draw).collect())
}

/// In the order of [`Measure::ALL`].
fn measures(
    chamfer: &Chamfer,
    a: &[Point],
    b: &[Point],
    sample: usize,
    options: &DistanceOptions,
) -> Result<[f64; 9], DistanceError> {
    let draw =
        |cloud: &[Point], n: usize, side: &str| shuffled(cloud, n, &format!("distances {side}"), sample, options);
    let n = options.emd_points.min(a.len()).min(b.len());
    let exact = emd(&draw(a, n, "emd a"), &draw(b, n, "emd b"))?;
    let n = options.sinkhorn_points;
    let entropic = of_sinkhorn(&draw(a, n, "sinkhorn a"), &draw(b, n, "sinkhorn b"), options)?;
    let sliced = sliced_wasserstein(a, b, options.directions, options.seed)?;
    Ok([
        chamfer.sum_m2,
        chamfer.mean_m2,
        chamfer.a_to_b_m2,
        chamfer.b_to_a_m2,
        chamfer.mean_m,
        chamfer.density_aware,
        exact,
        entropic,
        sliced,
    ])
}

fn of_sinkhorn(a: &[Point], b: &[Point], options: &DistanceOptions) -> Result<f64, DistanceError> {
    sinkhorn(a, b, options.sinkhorn_epsilon_m, options.sinkhorn_iterations)
}

/// Distances between two random halves of one cloud; `None` for a single-point cloud.
fn floor(cloud: &[Point], sample: usize, options: &DistanceOptions) -> Result<Option<[f64; 9]>, DistanceError> {
    if cloud.len() < 2 {
        return Ok(None);
    }
    let [a, b] = halves(cloud, sample, options);
    let chamfer = Chamfer::of_nearest(&nearest(&a, &b)?, &nearest(&b, &a)?);
    measures(&chamfer, &a, &b, sample, options).map(Some)
}

/// Two random halves, split per cell; the odd point of a cell goes into both.
fn halves(cloud: &[Point], sample: usize, options: &DistanceOptions) -> [Vec<Point>; 2] {
    let cell = |p: &Point| p.map(|v| (f64::from(v) / FLOOR_CELL_M).floor() as i32);
    let mut all = shuffled(cloud, cloud.len(), "distances floor", sample, options);
    all.sort_by_key(cell);
    let mut halves = [vec![], vec![]];
    for of_cell in all.chunk_by(|p, q| cell(p) == cell(q)) {
        for pair in of_cell.chunks(2) {
            halves[0].push(pair[0]);
            halves[1].push(pair[pair.len() - 1]);
        }
    }
    halves
}

/// Random subsample of `n` points; all points of a smaller cloud, shuffled.
fn shuffled(cloud: &[Point], n: usize, purpose: &str, sample: usize, options: &DistanceOptions) -> Vec<Point> {
    let mut points = cloud.to_vec();
    let n = n.min(points.len());
    let (drawn, _) = points.partial_shuffle(&mut stream(options.seed, purpose, 0, sample as u64), n);
    drawn.to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;
    use data::{Cloud, Object};
    use geometry::Box3;
    use rand::RngExt;

    /// A ground and a car; B also has a wall 60 m away.
    fn frames(id: &str) -> [Frame; 2] {
        let mut rng = stream(id.parse().unwrap(), "compare test", 0, 0);
        let mut cloud = |wall: bool| {
            let mut cloud = Cloud::new(3);
            for _ in 0..400 {
                cloud.values.extend([rng.random_range(-30.0..30.0), rng.random_range(-8.0..8.0), 0.0f32]);
            }
            for _ in 0..60 {
                cloud.values.extend([10.0 + rng.random_range(-2.0..2.0), 4.0, rng.random_range(0.2..1.2f32)]);
            }
            for _ in 0..if wall { 40 } else { 0 } {
                cloud.values.extend([60.0f32, rng.random_range(-5.0..5.0), rng.random_range(0.0..4.0f32)]);
            }
            cloud
        };
        [cloud(false), cloud(true)].map(|cloud| Frame {
            id: id.into(),
            cloud,
            objects: vec![Object {
                class: "Car".into(),
                bbox: Box3::from_array([10.0, 4.0, 0.7, 4.5, 1.0, 1.2, 0.0]),
                truncation: None,
                occlusion: None,
                image_box: None,
            }],
        })
    }

    fn options() -> DistanceOptions {
        DistanceOptions { emd_points: 64, sinkhorn_points: 64, sinkhorn_iterations: 30, ..DistanceOptions::default() }
    }

    fn region(_: &Frame, points: &[Point]) -> Vec<usize> {
        points.iter().map(|p| if p[0] > 50.0 { 2 } else { usize::from(p[2] > 0.1) }).collect()
    }

    fn run(threads: usize) -> Distances {
        let names = ["ground", "target", "scenery"].map(String::from).to_vec();
        let regions = Regions { names, of: Box::new(region) };
        let ids: Vec<String> = (0..30).map(|i| i.to_string()).collect();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| compare(["a", "b"], &ids, |id| Ok(frames(id)), Some(&regions), &options()).unwrap())
    }

    #[test]
    fn the_wall_is_named_and_stands_above_the_floor() {
        let found = run(2);
        assert!(found.regions[2].share > 0.95 && found.regions[2].points_a == 0, "{:?}", found.regions);
        assert!((found.regions.iter().map(|r| r.share).sum::<f64>() - 1.0).abs() < 1e-9);
        let of_regions = found.regions.iter().map(|r| r.a_to_b_m2 + r.b_to_a_m2).sum::<f64>() / found.frames as f64;
        let sum = found.rows.iter().find(|r| r.measure == Measure::ChamferSumM2).and_then(|r| r.mean).unwrap();
        assert!((of_regions / sum - 1.0).abs() < 1e-9, "{of_regions} instead of {sum}");
        let row =
            |part: Part, measure: Measure| found.rows.iter().find(|r| r.part == part && r.measure == measure).unwrap();
        for measure in Measure::ALL {
            let (whole, targets) = (row(Part::Whole, measure), row(Part::Targets, measure));
            let known = whole.interval.unwrap();
            assert!(known.low <= whole.mean.unwrap() && whole.mean.unwrap() <= known.high);
            if !matches!(measure, Measure::ChamferAToBM2 | Measure::ChamferDensityAware) {
                assert!(whole.mean.unwrap() > 1.5 * whole.floor.unwrap(), "{measure}: {whole:?}");
                assert!(targets.mean.unwrap() < 2.0 * targets.floor.unwrap() + 0.05, "{measure}: {targets:?}");
            }
        }
        // A has no points in the middle section: the pair is counted as left out.
        let mid = row(Part::Section(RangeSection::PAPER[1]), Measure::EmdM);
        assert_eq!((mid.frames, mid.left_out, mid.mean), (0, 30, None));
    }

    #[test]
    fn halves_lose_no_object() {
        let mut cloud: Vec<Point> = (0..9).map(|i| [10.0 + 0.01 * i as f32, 1.0, 1.0]).collect();
        cloud.extend([[90.0, 1.0, 1.0], [91.0, 1.0, 1.0], [-50.0, 1.0, 1.0]]);
        let [a, b] = halves(&cloud, 0, &options());
        let far = |half: &[Point], from: f32, to: f32| half.iter().filter(|p| p[0] >= from && p[0] < to).count();
        for half in [&a, &b] {
            assert_eq!((far(half, 0.0, 20.0), far(half, 88.0, 92.0), far(half, -60.0, 0.0)), (5, 1, 1), "{half:?}");
        }
        assert!(far(&a, 90.5, 92.0) != far(&b, 90.5, 92.0));
        let sum = floor(&cloud, 0, &options()).unwrap().unwrap()[0];
        assert!(sum < 2.5, "{sum}: no point is farther from the other half than its neighbour");
    }

    #[test]
    fn the_same_bits_for_any_number_of_threads() {
        assert!(run(1) == run(3));
    }

    #[test]
    fn ids_have_to_pair() {
        let ids = |names: &[&str]| -> Vec<String> { names.iter().map(|n| n.to_string()).collect() };
        assert_eq!(paired_ids(&ids(&["b", "a"]), &ids(&["a", "b"])).unwrap(), ids(&["b", "a"]));
        let error = paired_ids(&ids(&["a", "b"]), &ids(&["b", "c", "d"])).unwrap_err().to_string();
        assert!(error.contains("1 of 2 frames are only in the first and 2 of 3"), "{error}");
    }
}
