//! Statistics of labelled targets: their points in the box frame, aggregated by distance, their counts and positions,
//! and the values of the paper's data set table.

use crate::RangeSection;
use data::{DataError, Frame, stream};
use geometry::points_in_boxes;
use rand::seq::SliceRandom;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use statistics::mean;

/// Schema version of [`Targets`] as JSON.
pub const TARGETS_SCHEMA: &str = "lidarshift.targets/1";

/// Settings of the collection.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TargetOptions {
    /// Class name, compared case-insensitively.
    pub class: String,
    /// Points and targets farther away on the ground plane are excluded, m.
    pub max_range_m: f64,
    /// Range sections.
    pub sections: Vec<RangeSection>,
    /// Maximum number of points kept per section, drawn at random; the paper draws 20,000.
    pub most_points: usize,
    /// Random seed.
    pub seed: u64,
}

impl Default for TargetOptions {
    fn default() -> Self {
        TargetOptions {
            class: "Car".into(),
            max_range_m: 100.0,
            sections: RangeSection::PAPER.into(),
            most_points: 20_000,
            seed: 0,
        }
    }
}

/// A labelled target.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Target {
    /// Frame id.
    pub frame: String,
    /// Centre on the ground plane in the LiDAR frame, m: forward, left.
    pub at_m: [f64; 2],
    /// Heading, rad.
    pub yaw_rad: f64,
    /// Points in its box.
    pub points: u32,
}

/// All targets of a range section, aggregated in the box frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct TargetSection {
    /// The range section.
    pub section: RangeSection,
    /// Number of targets.
    pub targets: usize,
    /// Number of points in them.
    pub n_points: u64,
    /// Points in the box frame: offset from the box centre, m, forward, left, up. All points, or a random subset of
    /// [`TargetOptions::most_points`].
    pub points_m: Vec<[f32; 3]>,
}

/// Minimum, mean and maximum.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Spread {
    /// Mean; `None` without values.
    pub mean: Option<f64>,
    /// Minimum.
    pub min: Option<f64>,
    /// Maximum.
    pub max: Option<f64>,
}

/// Targets and statistics of a data set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Targets {
    /// [`TARGETS_SCHEMA`].
    pub schema: String,
    /// Name of the data set.
    pub dataset: String,
    /// Settings used.
    pub options: TargetOptions,
    /// Number of frames.
    pub frames: usize,
    /// x, y and z of all points, m.
    pub coordinates_m: [Spread; 3],
    /// Points per cloud.
    pub points_per_cloud: Spread,
    /// Points per target.
    pub points_per_target: Spread,
    /// Mean box size: length, width, height, m; `None` without boxes.
    pub mean_size_m: Option<[f64; 3]>,
    /// All targets in range, by frame.
    pub targets: Vec<Target>,
    /// By range section.
    pub sections: Vec<TargetSection>,
}

/// Contribution of one frame.
struct OfFrame {
    n_points: usize,
    sums: [f64; 3],
    min: [f64; 3],
    max: [f64; 3],
    targets: Vec<(Target, [f64; 3], Vec<[f32; 3]>)>,
}

/// Collects the targets of the frames with these ids. The result does not depend on the number of threads.
///
/// # Errors
/// A frame that cannot be read.
pub fn targets(
    dataset: &str,
    ids: &[String],
    load: impl Fn(&str) -> Result<Frame, DataError> + Sync,
    options: &TargetOptions,
) -> Result<Targets, DataError> {
    let of_frame = |id: &String| Ok(of_frame(&load(id)?, options));
    let found: Vec<Result<OfFrame, DataError>> = ids.par_iter().map(of_frame).collect();
    let found: Vec<OfFrame> = found.into_iter().collect::<Result<_, _>>()?;

    let n_points: usize = found.iter().map(|f| f.n_points).sum();
    let coordinates_m = [0, 1, 2].map(|k| {
        let sum: f64 = found.iter().map(|f| f.sums[k]).sum();
        let any = n_points > 0;
        Spread {
            mean: any.then(|| sum / n_points as f64),
            min: any.then(|| found.iter().map(|f| f.min[k]).fold(f64::INFINITY, f64::min)),
            max: any.then(|| found.iter().map(|f| f.max[k]).fold(f64::NEG_INFINITY, f64::max)),
        }
    });
    let per_cloud: Vec<f64> = found.iter().map(|f| f.n_points as f64).collect();
    let all: Vec<_> = found.into_iter().flat_map(|f| f.targets).collect();
    let per_target: Vec<f64> = all.iter().map(|(target, ..)| f64::from(target.points)).collect();
    let sections = options.sections.iter().enumerate().map(|(k, section)| {
        let inside = || all.iter().filter(|(target, ..)| section.contains(target.at_m[0].hypot(target.at_m[1])));
        let mut points_m: Vec<[f32; 3]> = inside().flat_map(|(_, _, points)| points).copied().collect();
        let n_points = points_m.len() as u64;
        if points_m.len() > options.most_points {
            let mut rng = stream(options.seed, "target points", 0, k as u64);
            points_m = points_m.partial_shuffle(&mut rng, options.most_points).0.to_vec();
        }
        TargetSection { section: *section, targets: inside().count(), n_points, points_m }
    });
    Ok(Targets {
        schema: TARGETS_SCHEMA.into(),
        dataset: dataset.into(),
        options: options.clone(),
        frames: ids.len(),
        coordinates_m,
        points_per_cloud: Spread::of(&per_cloud),
        points_per_target: Spread::of(&per_target),
        mean_size_m: (!all.is_empty())
            .then(|| [0, 1, 2].map(|k| mean(&all.iter().map(|(_, size, _)| size[k]).collect::<Vec<_>>()))),
        sections: sections.collect(),
        targets: all.into_iter().map(|(target, ..)| target).collect(),
    })
}

impl Spread {
    fn of(values: &[f64]) -> Self {
        let any = |v: f64| (!values.is_empty()).then_some(v);
        Spread {
            mean: any(mean(values)),
            min: any(values.iter().copied().fold(f64::INFINITY, f64::min)),
            max: any(values.iter().copied().fold(f64::NEG_INFINITY, f64::max)),
        }
    }
}

fn of_frame(frame: &Frame, options: &TargetOptions) -> OfFrame {
    let mut cloud = frame.cloud.clone();
    cloud.retain(|_, p| f64::from(p[0]).hypot(f64::from(p[1])) <= options.max_range_m && p[2].is_finite());
    let mut out = OfFrame {
        n_points: cloud.len(),
        sums: [0.0; 3],
        min: [f64::INFINITY; 3],
        max: [f64::NEG_INFINITY; 3],
        targets: Vec::new(),
    };
    for p in cloud.points() {
        for (k, v) in p[..3].iter().map(|v| f64::from(*v)).enumerate() {
            out.sums[k] += v;
            (out.min[k], out.max[k]) = (out.min[k].min(v), out.max[k].max(v));
        }
    }
    let of_class = frame.objects.iter().filter(|object| object.class.eq_ignore_ascii_case(&options.class));
    let boxes: Vec<_> =
        of_class.map(|object| object.bbox).filter(|b| b.center[0].hypot(b.center[1]) <= options.max_range_m).collect();
    for (b, inside) in boxes.iter().zip(points_in_boxes(&cloud.values, cloud.channels, &boxes, 0.0)) {
        let local = |i: &u32| b.to_local(cloud.xyz(*i as usize).map(f64::from)).map(|v| v as f32);
        let points: Vec<[f32; 3]> = inside.iter().map(local).collect();
        let at_m = [b.center[0], b.center[1]];
        let target = Target { frame: frame.id.clone(), at_m, yaw_rad: b.yaw_rad, points: points.len() as u32 };
        out.targets.push((target, b.size, points));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use data::{Cloud, Object};
    use geometry::Box3;

    /// A car at `x` with `n` points, all on its left front wheel.
    fn frame(x: f64, n: usize) -> Frame {
        let bbox = Box3::from_array([x, 3.0, 0.5, 4.0, 2.0, 1.2, 0.7]);
        let wheel = bbox.from_local([1.5, 0.9, -0.4]).map(|v| v as f32);
        let mut cloud = Cloud::new(3);
        cloud.values.extend([200.0, 0.0, 0.0, -1.0, 0.0, 9.0]);
        (0..n).for_each(|_| cloud.values.extend(wheel));
        let object = Object { class: "Car".into(), bbox, truncation: None, occlusion: None, image_box: None };
        Frame { id: format!("{x}"), cloud, objects: vec![object] }
    }

    #[test]
    fn targets_lie_over_each_other_in_their_own_frame() {
        let ids: Vec<String> = ["10", "12", "80", "120"].map(String::from).into();
        let load = |id: &str| Ok(frame(id.parse().unwrap(), if id == "12" { 30 } else { 5 }));
        let options = TargetOptions { most_points: 10, ..TargetOptions::default() };
        let found = targets("race", &ids, load, &options).unwrap();
        let of_section: Vec<_> = found.sections.iter().map(|s| (s.targets, s.n_points, s.points_m.len())).collect();
        assert_eq!(of_section, [(2, 35, 10), (0, 0, 0), (1, 5, 5)]);
        for p in found.sections.iter().flat_map(|s| &s.points_m) {
            assert!((p[0] - 1.5).abs() < 1e-4 && (p[1] - 0.9).abs() < 1e-4 && (p[2] + 0.4).abs() < 1e-4, "{p:?}");
        }
        // The target at 120 m and the point at 200 m are out of range.
        assert_eq!((found.targets.len(), found.targets[1].points), (3, 30));
        assert_eq!(found.coordinates_m[2].max, Some(9.0));
        assert_eq!((found.points_per_cloud.min, found.points_per_cloud.max), (Some(1.0), Some(31.0)));
        assert_eq!(found.mean_size_m.map(|s| s.map(|v| v as i32)), Some([4, 2, 1]));
        assert!(targets("race", &[], load, &options).unwrap().points_per_cloud.mean.is_none());
    }
}
