//! What a pair of a recording and its twin cannot tell.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A cause that is in both sides of a twin, which was made of the returns of the recording.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct BakedIn {
    /// Its name in the catalogue of the diagnosis.
    pub cause: String,
    /// Why the pair cannot tell it.
    pub why: String,
    /// What recording can tell it.
    pub tell_by: String,
}

const NOISE: &str = "the map averages the noise of many returns, and what is left of it in the map is added to it";
const WALL: &str = "a flat wall from a standing sensor at several distances, and diagnose it with --scans";
const POSES: &str = "the poses of the recording are those of the sensor, and both sides move with them";
const LABELS: &str = "the boxes of both sides are the recorded ones, and the objects were gathered in them";

/// Cause, why the pair cannot tell it, what to record.
const TABLE: &[[&str; 3]] = &[
    [
        "range_bias",
        "a bias or a scale of all ranges is in the map as it is in the returns",
        "walls at two distances that are known from elsewhere",
    ],
    [
        "range_drift",
        "a drift of all ranges is in the map as it is in the returns of the same time",
        "a wall at a known distance, at the beginning and at the end of a recording",
    ],
    [
        "reflectivity_walk",
        "surfaces of the map stand where returns of their own brightness put them",
        "plates of several reflectivities at one distance",
    ],
    ["range_noise", NOISE, WALL],
    ["signal_noise", NOISE, "surfaces of several reflectivities at the same distance from a standing sensor"],
    ["incidence_noise", NOISE, "a flat wall from a standing sensor at several angles"],
    [
        "angular_jitter",
        "shots of the twin have the recorded directions, and errors of the map are largest on grazing surfaces as well",
        "the edge of a wall from a standing sensor",
    ],
    ["sensor_extrinsics", POSES, "a calibration target at a known pose"],
    ["pitch_roll", POSES, "level ground from a vehicle whose attitude is known"],
    ["ego_attitude", POSES, "level ground from a vehicle whose attitude is known, at several speeds"],
    ["ground_error", "the ground of the twin is the recorded one", "the same street by a survey"],
    ["rolling_shutter", "both sides are shot from the same moving sensor", "the same street from a standing vehicle"],
    ["missing_object", "the twin has what the recording shows", "the same street by another sensor"],
    [
        "blooming",
        "the halo of a bright target is around it in all frames, and in the map",
        "the same street by another sensor",
    ],
    [
        "bright_target_dropout",
        "what is lost beside a bright target in all frames is not in the map",
        "the same street by another sensor",
    ],
    [
        "ghosts",
        "what a mirror shows in many frames is in the map, behind the mirror",
        "the same street by another sensor",
    ],
    ["wrong_shape", "the shapes of objects are the recorded ones", "an object of known size"],
    ["range_cut", "what no scan of the recording reached is not in the map", "the same street from nearer by"],
    ["near_cut", "what is nearer than all returns of the recording is not in the map", "scans by another sensor"],
    ["ego_occlusion", "what the own vehicle hides in all frames is not in the map", "scans with another mount"],
    ["label_offset", LABELS, "boxes by another sensor or another labeller"],
    ["time_offset", LABELS, "boxes by another sensor with its own clock"],
];

/// What every twin cannot tell.
pub fn baked_in() -> Vec<BakedIn> {
    let entry = |[cause, why, tell_by]: &[&str; 3]| BakedIn {
        cause: (*cause).into(),
        why: (*why).into(),
        tell_by: (*tell_by).into(),
    };
    TABLE.iter().map(entry).collect()
}
