//! Statistics of two data sets over the same frames: Table I of Huch et al. 2023.

use data::{DataError, Dataset, Frame};
use geometry::points_in_boxes;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fmt;

/// Schema version of [`StatisticsReport`] as JSON.
pub const STATISTICS_SCHEMA: &str = "lidarshift.eval_statistics/1";

/// Mean, minimum and maximum of a quantity.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Extent {
    /// Mean.
    pub mean: f64,
    /// Minimum.
    pub min: f64,
    /// Maximum.
    pub max: f64,
}

/// Statistics of one data set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SetStatistics {
    /// Its name.
    pub name: String,
    /// x, y and z of all points within the range, m.
    pub xyz_m: [Extent; 3],
    /// Points per cloud, within the range.
    pub points_per_cloud: Extent,
    /// Points per box; `None` if there is no box within the range.
    pub points_per_box: Option<Extent>,
    /// Boxes whose centre is within the range, in bird's eye view.
    pub boxes: usize,
    /// Boxes without a point.
    pub boxes_without_points: usize,
}

/// Statistics of two data sets.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct StatisticsReport {
    /// [`STATISTICS_SCHEMA`].
    pub schema: String,
    /// The split whose frames were counted.
    pub split: String,
    /// Number of frames counted in each data set.
    pub frames: usize,
    /// Points with |x| or |y| above this are not counted, nor are boxes farther away, m.
    pub range_m: f64,
    /// First and second data set.
    pub sets: [SetStatistics; 2],
}

/// Counts of one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameCounts {
    /// Sum, minimum and maximum of x, y, z, m.
    xyz: [[f64; 3]; 3],
    points: usize,
    box_points: Vec<usize>,
}

impl FrameCounts {
    /// Counts a frame: points with |x| and |y| up to `range_m`, boxes whose centre is at most that far away.
    pub fn of(frame: &Frame, range_m: f64) -> FrameCounts {
        let mut xyz = [[0.0, f64::INFINITY, f64::NEG_INFINITY]; 3];
        let mut points = 0;
        for p in frame.cloud.points() {
            let p = [f64::from(p[0]), f64::from(p[1]), f64::from(p[2])];
            if p[0].abs() <= range_m && p[1].abs() <= range_m {
                points += 1;
                for k in 0..3 {
                    xyz[k] = [xyz[k][0] + p[k], xyz[k][1].min(p[k]), xyz[k][2].max(p[k])];
                }
            }
        }
        let near = frame.objects.iter().map(|o| o.bbox).filter(|b| b.center[0].hypot(b.center[1]) <= range_m);
        let boxes: Vec<_> = near.collect();
        let inside = points_in_boxes(&frame.cloud.values, frame.cloud.channels, &boxes, 0.0);
        FrameCounts { xyz, points, box_points: inside.iter().map(Vec::len).collect() }
    }
}

/// Statistics of a data set from the counts of its frames; `None` if there is no point within the range.
pub fn sum_up(name: &str, frames: &[FrameCounts]) -> Option<SetStatistics> {
    let points: usize = frames.iter().map(|f| f.points).sum();
    if points == 0 {
        return None;
    }
    let extent = |values: &[usize]| {
        let sum: usize = values.iter().sum();
        let (least, most) = (values.iter().min()?, values.iter().max()?);
        Some(Extent { mean: sum as f64 / values.len() as f64, min: *least as f64, max: *most as f64 })
    };
    let axis = |k: usize| Extent {
        mean: frames.iter().map(|f| f.xyz[k][0]).sum::<f64>() / points as f64,
        min: frames.iter().map(|f| f.xyz[k][1]).fold(f64::INFINITY, f64::min),
        max: frames.iter().map(|f| f.xyz[k][2]).fold(f64::NEG_INFINITY, f64::max),
    };
    let box_points: Vec<usize> = frames.iter().flat_map(|f| f.box_points.iter().copied()).collect();
    Some(SetStatistics {
        name: name.into(),
        xyz_m: [axis(0), axis(1), axis(2)],
        points_per_cloud: extent(&frames.iter().map(|f| f.points).collect::<Vec<_>>())?,
        points_per_box: extent(&box_points),
        boxes: box_points.len(),
        boxes_without_points: box_points.iter().filter(|n| **n == 0).count(),
    })
}

/// Computes the statistics of a split of `a` in both data sets. `b` must hold the same frames under the same names.
pub fn compare_statistics(a: &Dataset, b: &Dataset, split: &str, range_m: f64) -> Result<StatisticsReport, DataError> {
    let ids = a.ids(split)?;
    let there: BTreeSet<String> = b.all_ids()?.into_iter().collect();
    if let Some(id) = ids.iter().find(|id| !there.contains(*id)) {
        let message = format!("has no frame {id:?}, which the other data set has: the two do not show the same frames");
        return Err(DataError::file(&b.config.root, message));
    }
    let count = |set: &Dataset| {
        let frames = ids.par_iter().map(|id| Ok(FrameCounts::of(&set.load(id)?, range_m)));
        // Collects all results first, so that the first bad frame is reported for any number of threads.
        let frames: Vec<Result<FrameCounts, DataError>> = frames.collect();
        let frames = frames.into_iter().collect::<Result<Vec<_>, _>>()?;
        let none =
            || DataError::file(&set.config.root, format!("has no point within {range_m} m in the split {split:?}"));
        sum_up(&set.config.name, &frames).ok_or_else(none)
    };
    let sets = [count(a)?, count(b)?];
    Ok(StatisticsReport { schema: STATISTICS_SCHEMA.into(), split: split.into(), frames: ids.len(), range_m, sets })
}

impl StatisticsReport {
    /// Table rows: label, values in both data sets, and the number of decimals.
    fn rows(&self) -> Vec<(String, [Option<f64>; 2], usize)> {
        let mut rows = Vec::new();
        let both = |f: &dyn Fn(&SetStatistics) -> Option<f64>| [f(&self.sets[0]), f(&self.sets[1])];
        type Part = (&'static str, fn(&Extent) -> f64);
        let parts: [Part; 3] = [("mean", |e| e.mean), ("min", |e| e.min), ("max", |e| e.max)];
        for (part, value) in parts {
            for (k, axis) in ["x", "y", "z"].into_iter().enumerate() {
                rows.push((format!("{part} {axis}, m"), both(&|s| Some(value(&s.xyz_m[k]))), 1));
            }
        }
        for (part, value) in parts {
            rows.push((format!("points a cloud, {part}"), both(&|s| Some(value(&s.points_per_cloud))), 0));
        }
        for (part, value) in parts {
            rows.push((format!("points a box, {part}"), both(&|s| s.points_per_box.as_ref().map(value)), 0));
        }
        rows.push(("boxes".into(), both(&|s| Some(s.boxes as f64)), 0));
        rows.push(("boxes without points".into(), both(&|s| Some(s.boxes_without_points as f64)), 0));
        rows
    }

    /// Mean points per box in the first data set divided by that in the second: the paper's estimate of lost points.
    pub fn box_point_ratio(&self) -> Option<f64> {
        let [a, b] = [&self.sets[0], &self.sets[1]].map(|s| s.points_per_box.map(|e| e.mean));
        Some(a? / b.filter(|mean| *mean > 0.0)?)
    }
}

impl fmt::Display for StatisticsReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [a, b] = [&self.sets[0].name, &self.sets[1].name];
        let width = a.len().max(b.len()).max(12);
        writeln!(f, "{} frames of the split {:?}, points within {} m", self.frames, self.split, self.range_m)?;
        writeln!(f, "{:24} {a:>width$} {b:>width$}", "")?;
        for (what, values, digits) in self.rows() {
            let [a, b] = values.map(|v| v.map_or("-".into(), |v| format!("{v:.digits$}")));
            writeln!(f, "{what:24} {a:>width$} {b:>width$}")?;
        }
        match self.box_point_ratio() {
            Some(ratio) => writeln!(f, "points a box, first to second: {:.1} %", ratio * 100.0),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use data::write::write_split;
    use data::{Cloud, Layout, Object};
    use geometry::Box3;

    fn frame(id: &str, points: &[[f32; 3]], boxes: &[[f64; 2]]) -> Frame {
        let object = |[x, y]: &[f64; 2]| Object {
            class: "Car".into(),
            bbox: Box3::from_array([*x, *y, 0.0, 4.0, 2.0, 2.0, 0.0]),
            truncation: None,
            occlusion: None,
            image_box: None,
        };
        let values = points.iter().flat_map(|[x, y, z]| [*x, *y, *z, 0.5]).collect();
        Frame { id: id.into(), cloud: Cloud { values, channels: 4 }, objects: boxes.iter().map(object).collect() }
    }

    fn frames() -> [Frame; 2] {
        [
            frame(
                "000000",
                &[[10.0, 0.0, 0.5], [11.0, 0.5, 0.0], [-100.0, 100.0, 4.0], [100.5, 0.0, 50.0]],
                &[[10.5, 0.0], [50.0, 0.0]],
            ),
            frame("000001", &[[0.0, -3.0, -1.5]], &[[99.0, 99.0]]),
        ]
    }

    #[test]
    fn points_and_boxes_within_the_range_are_counted() {
        let counts: Vec<FrameCounts> = frames().iter().map(|f| FrameCounts::of(f, 100.0)).collect();
        let got = sum_up("a", &counts).unwrap();
        assert_eq!(got.xyz_m[0], Extent { mean: (10.0 + 11.0 - 100.0) / 4.0, min: -100.0, max: 11.0 });
        assert_eq!(got.xyz_m[1], Extent { mean: (0.5 + 100.0 - 3.0) / 4.0, min: -3.0, max: 100.0 });
        assert_eq!(got.xyz_m[2], Extent { mean: 3.0 / 4.0, min: -1.5, max: 4.0 });
        assert_eq!(got.points_per_cloud, Extent { mean: 2.0, min: 1.0, max: 3.0 });
        assert_eq!(got.points_per_box, Some(Extent { mean: 1.0, min: 0.0, max: 2.0 }));
        assert_eq!((got.boxes, got.boxes_without_points), (2, 1), "the box at 140 m does not count");
        assert_eq!(sum_up("none", &[FrameCounts::of(&frame("a", &[[200.0, 0.0, 0.0]], &[]), 100.0)]), None);
    }

    #[test]
    fn two_data_sets_beside_each_other() {
        let folder = tempfile::tempdir().unwrap();
        let [a, b] = ["measured", "sim"].map(|name| folder.path().join(name));
        let [first, second] = frames();
        let more =
            frame("000000", &[[10.0, 0.0, 0.5], [11.0, 0.5, 0.0], [9.5, 0.1, 0.0], [10.5, 0.0, 0.1]], &[[10.5, 0.0]]);
        for (root, first) in [(&a, &first), (&b, &more)] {
            Layout::Kitti.write_frame(root, first).unwrap();
            Layout::Kitti.write_frame(root, &second).unwrap();
            write_split(&root.join("ImageSets/train.txt"), &["000000", "000001"]).unwrap();
        }
        let open = |path| Dataset::open(path).unwrap();
        let report = compare_statistics(&open(&a), &open(&b), "train", 100.0).unwrap();
        assert_eq!((report.frames, &report.sets[1].name[..]), (2, "sim"));
        assert_eq!(report.box_point_ratio(), Some(1.0 / 4.0));
        let text = report.to_string();
        assert!(text.contains("measured") && text.contains("points a box, mean") && text.contains("25.0 %"), "{text}");
        let json = serde_json::to_value(&report).unwrap();
        assert_eq!(json["schema"], STATISTICS_SCHEMA);
        assert_eq!(json["sets"][0]["points_per_cloud"]["max"], 3.0);

        std::fs::remove_file(b.join("velodyne/000001.bin")).unwrap();
        let error = compare_statistics(&open(&a), &open(&b), "train", 100.0).unwrap_err().to_string();
        assert!(error.contains("sim: has no frame \"000001\""), "{error}");
    }
}
