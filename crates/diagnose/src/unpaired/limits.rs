//! What two data sets of different streets cannot tell.

use crate::catalogue::Cause;
use crate::diagnosis::Unidentifiable;

/// Why a cause needs the same scenes on both sides.
const PLACES: &str = "where a surface should be is only known from the same scene";

/// What tells causes of places.
const SAME_SCENES: &str =
    "the same scenes on both sides: simulate the recorded ones, or make a twin of the recording (lidarshift twin)";

/// Cause, why, what to record.
const TABLE: &[(Cause, &str, &str)] = &[
    (Cause::RangeBias, "a bias of all ranges moves a street as a whole", "a wall at two surveyed distances"),
    (Cause::RangeDrift, "a bias of all ranges moves a street as a whole", "a wall, at the beginning and at the end"),
    (Cause::ReflectivityWalk, PLACES, "plates of several reflectivities at one distance"),
    (Cause::BeamRangeOffset, PLACES, "flat walls with a spinning sensor, and diagnose them with --scans"),
    (Cause::BeamElevationOffset, PLACES, "a level hall, or a survey of the road; or the same scenes on both sides"),
    (Cause::SensorExtrinsics, PLACES, SAME_SCENES),
    (Cause::PitchRoll, "roads have slopes of their own", SAME_SCENES),
    (Cause::EgoAttitude, "roads have slopes of their own", SAME_SCENES),
    (Cause::GroundError, "roads differ from street to street", SAME_SCENES),
    (Cause::RollingShutter, "a sheared street is another street", SAME_SCENES),
    (Cause::MissingObject, "other streets have other things", SAME_SCENES),
    (Cause::WrongShape, "other streets have other cars", SAME_SCENES),
    (Cause::MaterialDropout, "a surface that is lost as a whole is not seen to be there", SAME_SCENES),
    (Cause::NearCut, "another street may have nothing near", SAME_SCENES),
    (Cause::PacketLoss, "which shots should have a return is only known from the same scene", SAME_SCENES),
    (Cause::DualReturns, "other streets have other edges", SAME_SCENES),
    (
        Cause::HeavyTails,
        "the surfaces of another street have other small things on them",
        "a flat wall from a standing sensor, or the same scenes on both sides",
    ),
    (Cause::Blooming, "other streets have other bright things", SAME_SCENES),
    (Cause::BrightTargetDropout, "other streets have other bright things", SAME_SCENES),
    (Cause::Ghosts, "other streets have other mirrors, and other things behind them", SAME_SCENES),
    (Cause::Spray, "behind other vehicles other things stand", SAME_SCENES),
    (Cause::LabelOffset, "a label is compared with that of the same object", SAME_SCENES),
    (Cause::TimeOffset, "a label is compared with that of the same object", SAME_SCENES),
    (Cause::IntensityLaw, "other streets have other reflectivities", SAME_SCENES),
    (
        Cause::BeamIntensity,
        "other streets have other reflectivities",
        "scans of one spinning sensor, and diagnose them with --scans",
    ),
];

/// All of it.
pub(super) fn not_identifiable() -> Vec<Unidentifiable> {
    let entry = |(cause, why, tell_by): &(Cause, &str, &str)| Unidentifiable {
        cause: *cause,
        why: (*why).into(),
        tell_by: (*tell_by).into(),
    };
    TABLE.iter().map(entry).collect()
}
