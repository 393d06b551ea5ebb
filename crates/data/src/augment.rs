//! Data augmentation for training: random changes of a frame's points together with its boxes.
//!
//! Each change is a pure function of the frame, its configuration and a random stream. The defaults are those of
//! OpenPCDet for PointPillars on KITTI (`pointpillar.yaml`): no translation and no noise of single objects. Pasted
//! objects keep the z at which they were recorded, or with `gt_sampling.ground` their height above the ground. Image
//! boxes are not changed, because they are used for KITTI's difficulty only.

mod gt_sampling;
mod object_noise;
mod points;
mod world;

pub use gt_sampling::{GtSamplingConfig, sample_gt};
pub use object_noise::{ObjectNoiseConfig, noise_objects};
pub use points::{crop_to_range, shuffle_points};
pub use world::{flip, rotate, scale, translate};

use crate::{DataError, Frame, GtDatabase, Stream};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::f64::consts::FRAC_PI_4;

/// Configuration of the augmentation. The steps are applied in the order of these fields.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AugmentConfig {
    /// Ground-truth sampling: pastes objects of other frames.
    pub gt_sampling: GtSamplingConfig,
    /// Translation and rotation of single objects.
    pub object_noise: ObjectNoiseConfig,
    /// Probability of a flip along the x axis: y becomes -y.
    pub flip_along_x_probability: f64,
    /// Probability of a flip along the y axis: x becomes -x.
    pub flip_along_y_probability: f64,
    /// Smallest and largest rotation about z, rad. Drawn uniformly.
    pub rotation_rad: [f64; 2],
    /// Smallest and largest scale factor. Drawn uniformly.
    pub scaling: [f64; 2],
    /// Standard deviation of the translation along x, y and z, m.
    pub translation_std_m: [f64; 3],
    /// Shuffle the points, so that a pillar with too many points keeps a random subset.
    pub shuffle_points: bool,
}

impl Default for AugmentConfig {
    fn default() -> Self {
        AugmentConfig {
            gt_sampling: GtSamplingConfig::default(),
            object_noise: ObjectNoiseConfig::default(),
            flip_along_x_probability: 0.5,
            flip_along_y_probability: 0.0,
            rotation_rad: [-FRAC_PI_4, FRAC_PI_4],
            scaling: [0.95, 1.05],
            translation_std_m: [0.0; 3],
            shuffle_points: true,
        }
    }
}

impl AugmentConfig {
    /// The configuration that changes nothing.
    pub fn none() -> Self {
        AugmentConfig {
            gt_sampling: GtSamplingConfig { enabled: false, ..GtSamplingConfig::default() },
            object_noise: ObjectNoiseConfig::default(),
            flip_along_x_probability: 0.0,
            flip_along_y_probability: 0.0,
            rotation_rad: [0.0; 2],
            scaling: [1.0; 2],
            translation_std_m: [0.0; 3],
            shuffle_points: false,
        }
    }

    /// Checks the values. The error is a message for the first invalid one.
    pub fn check(&self) -> Result<(), String> {
        let interval = |v: [f64; 2]| v[0] <= v[1] && v.iter().all(|v| v.is_finite());
        let probability = |p: f64| (0.0..=1.0).contains(&p);
        let spread = |v: &[f64; 3]| v.iter().all(|v| *v >= 0.0 && v.is_finite());
        let checks = [
            (probability(self.flip_along_x_probability), "flip_along_x_probability is not between 0 and 1"),
            (probability(self.flip_along_y_probability), "flip_along_y_probability is not between 0 and 1"),
            (interval(self.rotation_rad), "rotation_rad is not [smallest, largest]"),
            (interval(self.scaling) && self.scaling[0] > 0.0, "scaling is not [smallest, largest], both above 0"),
            (spread(&self.translation_std_m), "translation_std_m has a negative value"),
            (interval(self.object_noise.rotation_rad), "object_noise.rotation_rad is not [smallest, largest]"),
            (spread(&self.object_noise.translation_std_m), "object_noise.translation_std_m has a negative value"),
        ];
        if let Some(ground) = &self.gt_sampling.ground {
            ground.check().map_err(|message| format!("gt_sampling.{message}"))?;
        }
        checks.into_iter().find(|(valid, _)| !valid).map_or(Ok(()), |(_, message)| Err(message.into()))
    }
}

/// Applies all steps of `config`. Ground-truth sampling is skipped if there is no database. The resulting yaws are in
/// [-pi, pi).
///
/// # Errors
/// A database whose file cannot be read; none without a database.
pub fn augment(
    mut frame: Frame,
    config: &AugmentConfig,
    database: Option<&GtDatabase>,
    stream: &mut Stream,
) -> Result<Frame, DataError> {
    if let Some(database) = database.filter(|_| config.gt_sampling.enabled) {
        frame = sample_gt(frame, &config.gt_sampling, database, stream)?;
    }
    frame = noise_objects(frame, &config.object_noise, stream);
    frame = flip(frame, config.flip_along_x_probability, config.flip_along_y_probability, stream);
    frame = rotate(frame, config.rotation_rad, stream);
    frame = scale(frame, config.scaling, stream);
    frame = translate(frame, config.translation_std_m, stream);
    if config.shuffle_points {
        frame = shuffle_points(frame, stream);
    }
    for object in &mut frame.objects {
        object.bbox = object.bbox.with_wrapped_yaw();
    }
    Ok(frame)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Cloud, Object, stream};
    use geometry::{Box3, points_in_boxes};
    use proptest::prelude::*;

    pub(super) fn object(values: [f64; 7]) -> Object {
        let bbox = Box3::from_array(values);
        Object { class: "Car".into(), bbox, truncation: None, occlusion: None, image_box: None }
    }

    /// Boxes in a row, each with points inside. No point is within 1 mm of a side of its box.
    pub(super) fn scene(seed: u64, objects: usize) -> Frame {
        use rand::RngExt;
        let mut rng = stream(seed, "scene", 0, 0);
        let objects: Vec<_> = (0..objects)
            .map(|i| {
                object([
                    8.0 + 9.0 * i as f64,
                    rng.random_range(-9.0..9.0),
                    -1.0,
                    4.0,
                    1.8,
                    1.6,
                    rng.random_range(-3.0..3.0),
                ])
            })
            .collect();
        let mut values = Vec::new();
        for object in &objects {
            for _ in 0..40 {
                let local = [0, 1, 2].map(|i| rng.random_range(-0.9..0.9) * object.bbox.size[i]);
                if (0..3).all(|i| (local[i].abs() - object.bbox.size[i] / 2.0).abs() > 1e-3) {
                    values.extend(object.bbox.from_local(local).map(|v| v as f32));
                    values.push(rng.random());
                }
            }
        }
        Frame { id: seed.to_string(), cloud: Cloud { values, channels: 4 }, objects }
    }

    pub(super) fn members(frame: &Frame) -> Vec<Vec<u32>> {
        let boxes: Vec<_> = frame.objects.iter().map(|o| o.bbox).collect();
        points_in_boxes(&frame.cloud.values, frame.cloud.channels, &boxes, 0.0)
    }

    proptest! {
        #[test]
        fn points_stay_in_their_boxes(seed in any::<u64>(), turn in -3.2f64..3.2, size in 0.5f64..2.0, shift in 0.0f64..3.0) {
            let frame = scene(seed, 5);
            let before = members(&frame);
            prop_assert!(before.iter().any(|m| !m.is_empty()));
            let mut rng = stream(seed, "augment", 0, 0);
            for changed in [
                flip(frame.clone(), 1.0, 0.0, &mut rng),
                flip(frame.clone(), 0.0, 1.0, &mut rng),
                rotate(frame.clone(), [turn, turn], &mut rng),
                scale(frame.clone(), [size, size], &mut rng),
                translate(frame.clone(), [shift; 3], &mut rng),
                augment(frame.clone(), &AugmentConfig { shuffle_points: false, ..AugmentConfig::default() }, None, &mut rng).unwrap(),
            ] {
                prop_assert_eq!(&members(&changed), &before);
                prop_assert!(changed.objects.iter().all(|o| o.bbox.size.iter().all(|s| *s > 0.0)));
            }
        }
    }

    #[test]
    fn none_changes_nothing_and_equal_streams_give_equal_results() {
        let frame = scene(3, 4);
        assert_eq!(augment(frame.clone(), &AugmentConfig::none(), None, &mut stream(1, "a", 0, 0)).unwrap(), frame);
        let noisy = AugmentConfig {
            object_noise: ObjectNoiseConfig { translation_std_m: [0.5; 3], rotation_rad: [-0.5, 0.5], tries: 20 },
            translation_std_m: [0.2; 3],
            ..AugmentConfig::default()
        };
        let run = |seed| augment(frame.clone(), &noisy, None, &mut stream(seed, "a", 0, 0)).unwrap();
        assert_eq!(run(1), run(1));
        assert_ne!(run(1), run(2));
        assert!(noisy.check().is_ok() && AugmentConfig { scaling: [0.0, 1.0], ..noisy }.check().is_err());
    }

    #[test]
    fn flips_match_openpcdet() {
        let frame = Frame {
            id: "a".into(),
            cloud: Cloud { values: vec![1.0, 2.0, 3.0, 0.5], channels: 4 },
            objects: vec![object([1.0, 2.0, 3.0, 4.0, 2.0, 1.5, 0.4])],
        };
        let rng = &mut stream(0, "a", 0, 0);
        let along_x = flip(frame.clone(), 1.0, 0.0, rng);
        assert_eq!(along_x.cloud.values, [1.0, -2.0, 3.0, 0.5]);
        assert_eq!(along_x.objects[0].bbox.to_array(), [1.0, -2.0, 3.0, 4.0, 2.0, 1.5, -0.4]);
        let along_y = flip(frame, 0.0, 1.0, rng);
        assert_eq!(along_y.cloud.values, [-1.0, 2.0, 3.0, 0.5]);
        assert_eq!(along_y.objects[0].bbox.yaw_rad, -(0.4 + std::f64::consts::PI));
    }

    #[test]
    fn defaults_round_trip_through_toml_and_unknown_keys_are_refused() {
        assert_eq!(toml::from_str::<AugmentConfig>("").unwrap(), AugmentConfig::default());
        let text = toml::to_string(&AugmentConfig::default()).unwrap();
        assert_eq!(toml::from_str::<AugmentConfig>(&text).unwrap(), AugmentConfig::default());
        assert!(toml::from_str::<AugmentConfig>("flipp = 1").is_err());
    }
}
