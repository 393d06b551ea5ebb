//! The gap between a network on its own data and the same network on other data, split into what the labels, the sensor
//! and the scene take.
//!
//! A network is trained on `T` and tested on `T` and on `M`. Its AP on `M` is scored against the labels of `M` and
//! against the true boxes. The difference of the two is the labels' part: nothing else differs. What remains between
//! `T` and the true boxes of `M` is sensor and scene. A test set with the scenes of `T` and the sensor of `M`
//! ([`Between`](super::Between)) tells these two from each other.

use super::build::Drawn;
use super::{MatrixOptions, MatrixPlan, Quantity, Reference};
use crate::RangeSection;
use crate::bootstrap::Interval;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A part of a gap.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Part {
    /// Percentage points of AP that it takes; negative where it gives.
    pub points: f64,
    /// Bootstrap interval with the same resamples of frames and seeds in all cells.
    pub interval: Option<Interval>,
}

/// The gap of a network between its own data and another test set, with its parts. `total` is the sum of the parts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Split {
    /// [`Place::name`](super::Place::name) of the network.
    pub network: String,
    /// [`Place::name`](super::Place::name) of the data set it was trained on.
    pub train_set: String,
    /// [`Place::name`](super::Place::name) of the other test set.
    pub test_set: String,
    /// Class name.
    pub class: String,
    /// Range section; `None`: full range.
    pub section: Option<RangeSection>,
    /// [`Quantity::Ap40`] or [`Quantity::BevAp40`].
    pub quantity: Quantity,
    /// IoU threshold.
    pub overlap: f64,
    /// AP on its own data less AP on the other test set against its labels.
    pub total: Part,
    /// AP against the true boxes, or else the repaired labels, less AP against the labels; `None` where neither is
    /// known.
    pub label: Option<Part>,
    /// AP on its own data less AP against the best boxes that are known of the other test set.
    pub sensor_and_scene: Part,
    /// The sensor's part of it; `None` without a test set with the scenes of the one and the sensor of the other.
    pub sensor: Option<Part>,
    /// The scene's part of it.
    pub scene: Option<Part>,
    /// Whether both test sets have the same frames (by id). Otherwise the difference of the frames is in the scene's
    /// part.
    pub same_frames: bool,
}

impl Split {
    /// Whether tables show it: 3D AP over the full range.
    pub fn is_shown(&self, class: &str) -> bool {
        self.class == class && self.section.is_none() && self.quantity == Quantity::Ap40
    }
}

/// The cell and the boxes that come closest to the truth in it.
type Scored<'a> = (&'a Drawn, Reference);

fn best(drawn: &Drawn) -> Scored<'_> {
    (drawn, drawn.cell.references().last().unwrap_or_default())
}

/// The difference of value `i` of two cells.
fn part(a: Scored, b: Scored, i: usize, options: &MatrixOptions) -> Option<Part> {
    let [one, other] = [a, b].map(|(drawn, reference)| (drawn.cell.numbers_of(reference).get(i), drawn, reference));
    let points = one.0?.mean? - other.0?.mean?;
    let [one, other] = [one, other].map(|(_, drawn, reference)| &drawn.draws_of(reference)[i]);
    let draws = one.iter().zip(other).map(|(a, b)| a - b).collect();
    Some(Part { points, interval: options.bootstrap.interval(draws) })
}

/// All splits: by network, train set, and test set other than the train set.
pub(super) fn splits(plan: &MatrixPlan, drawn: &[Drawn], options: &MatrixOptions) -> Vec<Split> {
    let find = |network: &str, train: &str, test: &str| {
        drawn.iter().find(|d| (&*d.cell.network, &*d.cell.train_set, &*d.cell.test_set) == (network, train, test))
    };
    let mut splits = Vec::new();
    for other in drawn.iter().filter(|d| d.cell.train_set != d.cell.test_set) {
        let (network, train, test) = (&*other.cell.network, &*other.cell.train_set, &*other.cell.test_set);
        let Some(own) = find(network, train, train) else { continue };
        let stands_between = plan.between.iter().find(|b| b.scene_of == train && b.sensor_of == test);
        let middle = stands_between.and_then(|b| find(network, train, &b.test_set));
        let closest = best(other);
        for (i, number) in other.cell.numbers.iter().enumerate() {
            if !matches!(number.quantity, Quantity::Ap40 | Quantity::BevAp40) {
                continue;
            }
            let labels = (other, Reference::Labels);
            let (Some(total), Some(sensor_and_scene)) =
                (part(best(own), labels, i, options), part(best(own), closest, i, options))
            else {
                continue;
            };
            splits.push(Split {
                network: network.into(),
                train_set: train.into(),
                test_set: test.into(),
                class: number.class.clone(),
                section: number.section,
                quantity: number.quantity,
                overlap: number.overlap,
                total,
                label: (closest.1 != Reference::Labels).then(|| part(closest, labels, i, options)).flatten(),
                sensor_and_scene,
                sensor: middle.and_then(|middle| part(best(own), best(middle), i, options)),
                scene: middle.and_then(|middle| part(best(middle), closest, i, options)),
                same_frames: own.frames_key == other.frames_key,
            });
        }
    }
    splits
}
