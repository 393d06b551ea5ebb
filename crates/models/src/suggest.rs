//! Fits a detector's range, grid and anchors to labelled boxes, with the reason for each change.

use crate::Preparer;
use crate::bev::{BackboneConfig, PillarsConfig};
use crate::config::{AnchorConfig, DetectorConfig};
use data::augment::flip;
use data::{AugmentConfig, Cloud, DataError, Dataset, Frame, GroundConfig, GroundHeight, Object, stream};
use geometry::{Box3, limit_period};
use rayon::prelude::*;
use statistics::{median_upper, quantile_linear};
use std::f64::consts::{FRAC_PI_8, PI};
use std::fmt::Write;

/// Fewest labelled boxes from which a suggestion is made.
pub const FEWEST_BOXES: usize = 30;

/// Share of the boxes at either end of an axis that the range need not hold: outliers of labels.
const OUTSIDE: f64 = 0.002;
/// Ground between the outermost boxes and the border of the range, m: the network sees the surroundings of every box.
const MARGIN_M: f64 = 2.0;
/// Space above and below the boxes, m.
const MARGIN_Z_M: f64 = 1.0;
/// Anchors or cells of the output map across the width of a box. With two of them every box has cells on itself: at 1.6
/// m for cars 1.9 m wide a third of the cars had nothing but a forced match, at 0.8 m none.
const CELLS_PER_WIDTH: f64 = 2.0;
/// Sides of pillars to choose from, m, largest first.
const PILLAR_SIDES_M: [f32; 10] = [0.8, 0.64, 0.5, 0.4, 0.32, 0.25, 0.2, 0.16, 0.125, 0.1];
/// Share of the boxes that an anchor's heading has to be close to, so that no other heading is needed.
const SAME_HEADING: f64 = 0.98;
/// Share of boxes with nothing but a forced match from which on training is warned about.
pub const FORCED_SHARE: f64 = 0.05;

/// The labelled boxes of some frames.
#[derive(Clone, Debug, Default)]
pub struct LabelledBoxes {
    /// The objects of each frame.
    pub frames: Vec<Vec<Object>>,
    /// Largest rotation about z that training adds to headings, rad.
    pub turned_rad: f64,
}

impl LabelledBoxes {
    /// The boxes of at most `most` frames, evenly spread. With `ground` their heights count from the ground; only then
    /// clouds are read.
    ///
    /// # Errors
    /// Labels, calibrations or clouds that cannot be read.
    pub fn read(
        dataset: &Dataset,
        ids: &[String],
        most: usize,
        ground: Option<&GroundConfig>,
    ) -> Result<Self, DataError> {
        let n = most.min(ids.len());
        let frame = |k: usize| {
            let id = &ids[k * ids.len() / n];
            let Some(ground) = ground else { return dataset.objects(id, &dataset.labels(id)?) };
            let frame = dataset.load(id)?;
            Ok(GroundHeight::of(&frame.cloud, ground).level(&frame).objects)
        };
        let frames: Vec<Result<_, DataError>> = (0..n).into_par_iter().map(frame).collect();
        Ok(LabelledBoxes { frames: frames.into_iter().collect::<Result<_, _>>()?, turned_rad: 0.0 })
    }

    /// The boxes as training shows them: flips double the frames, rotations turn the headings. The range is fitted to
    /// the places where boxes are, not to those to which a rotation about the sensor carries them.
    fn augmented(&self, augmentation: &AugmentConfig) -> Self {
        let mut frames = self.frames.clone();
        let (x, y) = (augmentation.flip_along_x_probability, augmentation.flip_along_y_probability);
        for [along_x, along_y] in [[x, 0.0], [0.0, y]].map(|flips| flips.map(f64::ceil)) {
            if along_x + along_y > 0.0 {
                let flipped = |objects: &Vec<Object>| {
                    let cloud = Cloud { values: Vec::new(), channels: 3 };
                    let frame = Frame { id: String::new(), cloud, objects: objects.clone() };
                    // A probability of 1 leaves nothing to chance.
                    flip(frame, along_x, along_y, &mut stream(0, "flips of boxes", 0, 0)).objects
                };
                frames.extend(frames.iter().map(flipped).collect::<Vec<_>>());
            }
        }
        let turned_rad = augmentation.rotation_rad.iter().fold(0.0f64, |most, r| most.max(r.abs()));
        LabelledBoxes { frames, turned_rad }
    }

    /// All boxes of a class.
    pub fn of_class<'a>(&'a self, class: &'a str) -> impl Iterator<Item = &'a Box3> {
        self.frames.iter().flatten().filter(move |o| o.class == class).map(|o| &o.bbox)
    }

    /// Median size of the boxes of a class in whole centimetres; `None` without boxes.
    pub(crate) fn median_size(&self, class: &str) -> Option<[f32; 3]> {
        self.of_class(class).next()?;
        Some([0, 1, 2].map(|i| centimetres(median(self.of_class(class).map(|b| b.size[i])))))
    }

    /// All boxes of some classes.
    pub fn of_classes(&self, classes: &[String]) -> Vec<Box3> {
        classes.iter().flat_map(|class| self.of_class(class).copied()).collect()
    }
}

/// A change of a detector's configuration.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Change {
    /// Key of the TOML.
    pub key: String,
    /// Value before.
    pub was: String,
    /// Value after.
    pub is: String,
    /// What in the labels asks for it.
    pub why: String,
}

/// How the anchors of a detector are assigned to a labelled box.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BoxMatch {
    /// Index of the class.
    pub class: usize,
    /// Anchors that are positive for the box.
    pub positive: usize,
    /// Whether no anchor reaches the threshold `matched`: the best one is positive by force.
    pub forced: bool,
}

/// How the anchors of a detector are assigned to all boxes of some frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Assignment {
    /// Share of the boxes with nothing but a forced match.
    pub forced: f64,
    /// Positive anchors a box, on average.
    pub positives: f64,
}

impl Assignment {
    /// Of a detector; `None` without anchors or boxes.
    pub fn of(detector: &DetectorConfig, boxes: &LabelledBoxes) -> Option<Self> {
        let preparer = Preparer::new(detector);
        let matches: Vec<BoxMatch> = boxes.frames.iter().flat_map(|objects| preparer.box_matches(objects)).collect();
        let n = matches.len() as f64;
        let forced = matches.iter().filter(|m| m.forced).count() as f64 / n;
        let positives = matches.iter().map(|m| m.positive as f64).sum::<f64>() / n;
        (n > 0.0).then_some(Assignment { forced, positives })
    }
}

/// A detector fitted to labelled boxes.
#[derive(Clone, Debug)]
pub struct Suggestion {
    /// The fitted detector.
    pub detector: DetectorConfig,
    /// What was changed, and why.
    pub changes: Vec<Change>,
    /// How the anchors are assigned to the boxes, before and after; `None` without anchors.
    pub assignment: Option<[Assignment; 2]>,
}

/// Fits a detector to labelled boxes.
///
/// # Errors
/// Fewer than [`FEWEST_BOXES`] boxes of its classes, or sizes that do not fit together afterwards.
pub fn suggest(detector: &DetectorConfig, boxes: &LabelledBoxes) -> Result<Suggestion, String> {
    let found = boxes.of_classes(&detector.classes);
    if found.len() < FEWEST_BOXES {
        return Err(format!(
            "{} labelled boxes of {} are too few for a suggestion; at least {FEWEST_BOXES} are needed",
            found.len(),
            detector.classes.join(", ")
        ));
    }
    let mut fitted = detector.clone();
    let mut changes = Vec::new();
    let shown = boxes.augmented(&detector.augmentation);
    fitted.network.fit(&mut fitted.range_m, &fitted.classes, &shown, &mut changes);
    fitted.check().map_err(|message| format!("the fitted detector does not hold together: {message}"))?;
    let assignment = Assignment::of(detector, boxes).zip(Assignment::of(&fitted, boxes)).map(|(a, b)| [a, b]);
    Ok(Suggestion { changes, assignment, detector: fitted })
}

impl Suggestion {
    /// The detector's TOML, with the reasons above it.
    ///
    /// # Errors
    /// A configuration that TOML cannot hold.
    pub fn to_toml(&self, from: &str, dataset: &str) -> Result<String, toml::ser::Error> {
        let mut text = format!("# {from}, fitted to the labels of {dataset}:\n");
        for change in &self.changes {
            let _ = writeln!(text, "# - {} = {} (was {}): {}", change.key, change.is, change.was, change.why);
        }
        text.push_str(&toml::to_string(&self.detector)?);
        Ok(text)
    }
}

/// Replaces a value, and records the change if it differs.
pub(crate) fn change<T: PartialEq + std::fmt::Debug>(
    changes: &mut Vec<Change>,
    key: &str,
    value: &mut T,
    is: T,
    why: String,
) {
    if *value != is {
        changes.push(Change { key: key.into(), was: format!("{value:?}"), is: format!("{is:?}"), why });
        *value = is;
    }
}

/// Smallest and largest value without outliers.
fn span(mut values: Vec<f64>) -> [f64; 2] {
    values.sort_by(f64::total_cmp);
    [OUTSIDE, 1.0 - OUTSIDE].map(|q| quantile_linear(&values, q))
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    median_upper(values.collect()).unwrap_or(f64::NAN)
}

/// Rounds to whole centimetres, as people write sizes.
fn centimetres(v: f64) -> f32 {
    ((v * 100.0).round() / 100.0) as f32
}

/// Fits the range: around the centres of all boxes with a margin, horizontally in whole multiples of `unit_m`, the side
/// of a cell of the coarsest map; without one in whole metres.
pub(crate) fn fit_range(range: &mut [f32; 6], boxes: &[Box3], unit_m: Option<[f64; 2]>, changes: &mut Vec<Change>) {
    let mut is = *range;
    let mut reasons = Vec::new();
    let half = median(boxes.iter().map(|b| b.size[0])) / 2.0;
    for axis in 0..2 {
        let [low, high] = span(boxes.iter().map(|b| b.center[axis]).collect());
        let unit = unit_m.map_or(1.0, |unit| unit[axis]);
        // Rounded to micrometres, so that 64 cells of 0.4 m are 25.6 m in f32.
        let cells = |v: f64| ((v / unit - 1e-6).ceil() * unit * 1e6).round() / 1e6;
        is[axis] = -cells(-(low - half - MARGIN_M)) as f32;
        is[axis + 3] = cells(high + half + MARGIN_M) as f32;
        reasons.push(format!("{} from {low:.1} to {high:.1} m", ["x", "y"][axis]));
    }
    let [low, _] = span(boxes.iter().map(|b| b.z_range().0).collect());
    let [_, high] = span(boxes.iter().map(|b| b.z_range().1).collect());
    is[2] = (low - MARGIN_Z_M).floor() as f32;
    is[5] = (high + MARGIN_Z_M).ceil() as f32;
    let why = format!(
        "{:.1} % of the boxes have centres with {} (half a box and {MARGIN_M} m around them), and reach from {low:.1} to \
         {high:.1} m in height ({MARGIN_Z_M} m around them)",
        100.0 * (1.0 - 2.0 * OUTSIDE),
        reasons.join(", ")
    );
    change(changes, "range_m", range, is, why);
}

/// Fits the side of square pillars so that a cell of the output map is at most half as wide as the narrowest class.
/// `stride` is the number of pillars a cell of the output map. A finer grid stays.
pub(crate) fn fit_pillars(
    size_m: &mut [f32; 3],
    stride: usize,
    classes: &[String],
    boxes: &LabelledBoxes,
    changes: &mut Vec<Change>,
) {
    let widths = classes.iter().map(|class| (class, median(boxes.of_class(class).map(|b| b.size[1]))));
    let Some((class, width)) = widths.filter(|(_, w)| w.is_finite()).min_by(|a, b| a.1.total_cmp(&b.1)) else { return };
    let limit = width / CELLS_PER_WIDTH / stride as f64;
    if f64::from(size_m[0].max(size_m[1])) <= limit + 1e-6 {
        return;
    }
    let side = PILLAR_SIDES_M.into_iter().find(|side| f64::from(*side) <= limit + 1e-6);
    let side = side.unwrap_or(PILLAR_SIDES_M[PILLAR_SIDES_M.len() - 1]);
    let why = format!(
        "{class} is {width:.2} m wide (median) and wants {CELLS_PER_WIDTH} anchors or cells across; with a stride of {stride} \
         they were {:.2} m apart, now {:.2} m",
        f64::from(size_m[1]) * stride as f64,
        f64::from(side) * stride as f64
    );
    change(changes, "network.pillars.size_m", size_m, [side, side, size_m[2]], why);
}

/// Fits pillars and range of a network on a grid.
pub(crate) fn fit_grid(
    pillars: &mut PillarsConfig,
    backbone: &BackboneConfig,
    range: &mut [f32; 6],
    classes: &[String],
    boxes: &LabelledBoxes,
    changes: &mut Vec<Change>,
) {
    let size_m = &mut pillars.size_m;
    fit_pillars(size_m, backbone.output_stride(), classes, boxes, changes);
    let found = boxes.of_classes(classes);
    let coarsest = backbone.strides.iter().product::<usize>() as f64;
    // Through decimal text, so that 0.4 stays 0.4.
    let side = |axis: usize| size_m[axis].to_string().parse::<f64>().unwrap_or(size_m[axis].into()) * coarsest;
    fit_range(range, &found, Some([side(0), side(1)]), changes);
    // A pillar spans the whole height.
    size_m[2] = range[5] - range[2];
}

/// Fits sizes, heights and headings of anchors to the boxes of their classes.
pub(crate) fn fit_anchors(anchors: &mut [AnchorConfig], boxes: &LabelledBoxes, changes: &mut Vec<Change>) {
    for anchor in anchors.iter_mut() {
        let Some(size) = boxes.median_size(&anchor.class) else { continue };
        let n = boxes.of_class(&anchor.class).count();
        let key = |name: &str| format!("network.anchors ({}).{name}", anchor.class);
        let bottom = centimetres(median(boxes.of_class(&anchor.class).map(|b| b.z_range().0)));
        let turn = |b: &&Box3| limit_period(b.yaw_rad, 0.5, PI).abs() + boxes.turned_rad;
        let turned = boxes.of_class(&anchor.class).filter(|b| turn(b) > FRAC_PI_8).count();
        let (size_key, bottom_key, rotations_key) = (key("size_m"), key("bottom_m"), key("rotations_rad"));
        change(changes, &size_key, &mut anchor.size_m, size, "median of the boxes".into());
        change(changes, &bottom_key, &mut anchor.bottom_m, bottom, "median bottom of the boxes".into());
        let share = 1.0 - turned as f64 / n as f64;
        let rotations = if share >= SAME_HEADING { vec![0.0] } else { vec![0.0, 1.57] };
        let why = format!("{:.1} % of the boxes stand within 22.5 degrees of the x axis in training", 100.0 * share);
        change(changes, &rotations_key, &mut anchor.rotations_rad, rotations, why);
    }
    // Every class needs the same number of headings.
    let most = anchors.iter().map(|a| a.rotations_rad.clone()).max_by_key(Vec::len).unwrap_or_default();
    for anchor in anchors.iter_mut().filter(|a| a.rotations_rad.len() < most.len()) {
        let key = format!("network.anchors ({}).rotations_rad", anchor.class);
        let why = "every class needs the same number of headings".to_string();
        change(changes, &key, &mut anchor.rotations_rad, most.clone(), why);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{NetworkConfig, find_detector};

    /// Cars 4.9 x 1.9 x 1.2 m on a road ahead and behind, at most 20 m to the side.
    fn cars(n: usize) -> LabelledBoxes {
        let car = |i: usize| {
            let t = i as f64 / n as f64;
            let bbox =
                Box3::from_array([160.0 * t - 80.0, 40.0 * (7.0 * t).fract() - 20.0, 0.7, 4.9, 1.9, 1.2, 0.1 * t]);
            Object { class: "Car".into(), bbox, truncation: None, occlusion: None, image_box: None }
        };
        LabelledBoxes { frames: (0..n).map(|i| vec![car(i)]).collect(), turned_rad: 0.0 }
    }

    #[test]
    fn the_coarse_network_gets_anchors_that_match() {
        let mut coarse = find_detector("pointpillars_race").unwrap();
        coarse.augmentation.rotation_rad = [-0.1, 0.1];
        let NetworkConfig::PointPillars(net) = &mut coarse.network else { unreachable!() };
        net.pillars.size_m = [0.8, 0.8, 13.0];
        coarse.range_m = [-102.4, -102.4, -3.0, 102.4, 102.4, 10.0];
        let suggestion = suggest(&coarse, &cars(400)).unwrap();
        let [before, after] = suggestion.assignment.unwrap().map(|a| a.forced);
        assert!(before > 0.5 && after < FORCED_SHARE, "{before} {after}");
        let NetworkConfig::PointPillars(net) = &suggestion.detector.network else { unreachable!() };
        assert_eq!((net.pillars.size_m[0], net.anchors[0].rotations_rad.as_slice()), (0.4, &[0.0][..]));
        let range = suggestion.detector.range_m;
        assert!((-26.0..=-22.0).contains(&range[1]) && (80.0..=90.0).contains(&range[3]), "{range:?}");
        assert_eq!(net.pillars.size_m[2], range[5] - range[2]);
        let text = suggestion.to_toml("pointpillars_race", "race").unwrap();
        assert_eq!(DetectorConfig::parse(&text).unwrap(), suggestion.detector);
        assert!(text.starts_with("# pointpillars_race, fitted to the labels of race:\n# - "), "{text}");
        // A second suggestion changes nothing.
        assert_eq!(suggest(&suggestion.detector, &cars(400)).unwrap().changes, []);
    }

    #[test]
    fn headings_across_need_a_second_anchor() {
        let mut boxes = cars(100);
        boxes.frames.iter_mut().flatten().step_by(4).for_each(|o| o.bbox.yaw_rad = 1.5);
        let suggestion = suggest(&find_detector("pointpillars_race_small").unwrap(), &boxes).unwrap();
        assert_eq!(suggestion.detector.network.anchors()[0].rotations_rad.len(), 2);
    }

    #[test]
    fn a_network_without_anchors_gets_mean_sizes() {
        let suggestion = suggest(&find_detector("pointrcnn_race_small").unwrap(), &cars(100)).unwrap();
        assert_eq!(suggestion.assignment, None);
        let NetworkConfig::PointRcnn(net) = &suggestion.detector.network else { unreachable!() };
        assert_eq!(net.point_head.mean_sizes[0].size_m, [4.9, 1.9, 1.2]);
    }

    #[test]
    fn few_boxes_are_refused() {
        let error = suggest(&find_detector("pointpillars_race").unwrap(), &cars(29)).unwrap_err();
        assert!(error.contains("29 labelled boxes of Car are too few"), "{error}");
    }
}
