//! Covariates: what the size of a difference depends on.

use super::identifiers;
use crate::channels::groups::Grouping;

identifiers! {
    /// What a finding depends on.
    Covariate {
        /// Azimuth in the sensor's frame.
        Azimuth = "azimuth",
        /// Brightness of the surface.
        Brightness = "brightness",
        /// Cosine of the angle of incidence.
        CosIncidence = "cos_incidence",
        /// A region of azimuth and elevation.
        Direction = "direction",
        /// Horizontal distance on the ground.
        DistanceOnTheGround = "distance on the ground",
        /// Range discontinuities.
        Edge = "edge",
        /// Range modulo the quantisation step.
        FractionOfTheStep = "fraction of the step",
        /// Nothing: the same everywhere.
        None = "none",
        /// The place in the scene.
        Place = "place",
        /// Range.
        Range = "range_m",
        /// Range times the tangent of the incidence: displacement along the surface for each radian.
        RangeTanIncidence = "range_m * tan(incidence)",
        /// Row of the sensor.
        Row = "row",
        /// Time within a scan.
        ScanPhase = "scan_phase",
        /// Time within a scan times the velocity of the object.
        ScanPhaseVelocity = "scan_phase * velocity",
        /// Velocity of an object relative to the ego vehicle.
        SeenVelocity = "seen_velocity_m_s",
        /// The sensor.
        Sensor = "sensor",
        /// Which side of an object faces the sensor.
        SideSeen = "side_seen",
        /// Received signal.
        Signal = "signal",
        /// Ground.
        SurfaceGround = "surface: ground",
        /// Bodies of labelled objects.
        SurfaceObject = "surface: object",
        /// Lower corners of labelled objects.
        SurfaceObjectCorner = "surface: object_corner",
        /// Walls, posts and other standing surfaces.
        SurfaceStanding = "surface: standing",
        /// Labelled objects with their corners.
        SurfaceWholeObject = "surface: whole_object",
        /// Time since the first frame.
        Time = "time_s",
        /// Velocity over the ground.
        Velocity = "velocity_m_s",
    }
}

impl From<Grouping> for Covariate {
    fn from(grouping: Grouping) -> Self {
        match grouping {
            Grouping::Row => Covariate::Row,
            Grouping::Azimuth => Covariate::Azimuth,
            Grouping::Range => Covariate::Range,
        }
    }
}
