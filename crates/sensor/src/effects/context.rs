//! Context of a frame that effects are applied with, and their random number streams.

use crate::directions::Sensors;
use crate::material::MaterialTable;
use crate::object::Group;
use crate::ray_caster::RayCaster;
use crate::rig::Rig;
use data::{Stream, stream};
use geometry::Box3;
use std::collections::BTreeSet;

/// A quantity that must be known of a finished cloud for an effect to be applied to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Need {
    /// Normals and angles of incidence.
    Incidence,
    /// Reflectivity of the surfaces.
    Reflectivity,
    /// Material of the surfaces.
    Material,
    /// Row of each point in the sensor's pattern.
    Row,
    /// Row and column of each point in the sensor's pattern.
    Grid,
    /// Time of each shot.
    Time,
    /// Boxes of the other cars.
    Cars,
    /// Velocities of the other cars relative to the ego vehicle.
    SeenMotion,
    /// Velocities of the ego vehicle and of the other cars.
    Motion,
}

impl Need {
    /// Description for error messages.
    pub fn description(self) -> &'static str {
        match self {
            Need::Incidence => "the angle of incidence",
            Need::Reflectivity => "the reflectivity of surfaces",
            Need::Material => "the material of surfaces",
            Need::Row => "the row of each point in the sensor's pattern",
            Need::Grid => "the row and column of each point in the sensor's pattern",
            Need::Time => "the time of each shot",
            Need::Cars => "boxes of the cars",
            Need::SeenMotion => "the relative motion of the cars",
            Need::Motion => "the motion of the cars",
        }
    }

    /// How to give it to a data set that does not tell it.
    pub fn how_to_give(self) -> &'static str {
        match self {
            Need::Incidence | Need::Row | Need::Grid => {
                "no rows stand out in its directions: give the sensors with their patterns (`--sensor`, or `rig` in its \
                 TOML), or the rows' elevations in the effect where it has them"
            }
            Need::Time => "give the sensors with their patterns (`--sensor`, or `rig` in its TOML)",
            Need::Reflectivity => {
                "say what its intensities mean (`intensity = \"returned_light\"` or `\"reflectivity\"` at the top of the \
                 list), or assume a value (`reflectivity = 0.1` there)"
            }
            Need::Material => "only attributes tell it, which `simulate` writes; name `surfaces` instead of materials",
            Need::Cars => "add labels",
            Need::SeenMotion => "it needs frame ids that are rising numbers, and labels",
            Need::Motion => {
                "it needs frame ids that are rising numbers, labels, and standing edges from which the own speed can be \
                 estimated"
            }
        }
    }
}

/// Another car in a frame. All values are in the cloud's frame.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelledCar {
    /// Number of the car, the same in all frames of a run.
    pub number: usize,
    /// True box.
    pub true_box: Box3,
    /// Box of its label.
    pub label: Box3,
    /// Velocity over ground, m/s.
    pub velocity: [f64; 3],
}

/// A frame without its scan.
#[derive(Clone, Copy)]
pub struct FrameContext<'a> {
    /// Seed of the data set.
    pub seed: u64,
    /// Name of the data set.
    pub set: &'a str,
    /// Number of the frame, a part of its random streams.
    pub index: u64,
    /// Time since the start of the first run, s.
    pub time_s: f64,
    /// The sensors.
    pub rig: &'a Rig,
    /// The materials.
    pub materials: &'a MaterialTable,
    /// Velocity of the ego vehicle, m/s, cloud's frame.
    pub ego_velocity: [f64; 3],
    /// Turn rate of the ego vehicle, rad/s, cloud's frame.
    pub ego_turn_rate: [f64; 3],
    /// The other cars.
    pub cars: &'a [LabelledCar],
    /// Scan patterns of the sensors as they were recovered from finished clouds; `None` in simulation.
    pub sensors: Option<&'a Sensors>,
    /// Scene for additional rays; `None` for a finished cloud.
    pub scene: Option<&'a dyn RayCaster>,
    /// Direction of the world's +x axis in the cloud's frame, rad counter-clockwise from +x.
    pub world_x_rad: f64,
}

/// Random number streams of one effect.
#[derive(Clone, Debug)]
pub struct Draws {
    seed: u64,
    purpose: String,
    frame: u64,
}

impl Draws {
    /// Streams of an effect for a frame.
    pub fn new(seed: u64, purpose: String, frame: u64) -> Draws {
        Draws { seed, purpose, frame }
    }

    /// Stream of this frame.
    pub fn of_frame(&self) -> Stream {
        stream(self.seed, &self.purpose, 1, self.frame)
    }

    /// Stream of this frame for the places of edges, which no return tells.
    pub fn of_edges(&self) -> Stream {
        stream(self.seed, &self.purpose, 2, self.frame)
    }

    /// Stream that is the same in every frame of the data set; each `number` has its own.
    pub fn of_set(&self, number: u64) -> Stream {
        stream(self.seed, &self.purpose, 0, number)
    }
}

/// An unmodelled undulation of the ground and all static objects on it:
/// `height = amplitude_m * sin(2 pi s / length_m + phase_rad)`, m, s the arc length along the centre line, m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Undulation {
    /// Amplitude, m.
    pub amplitude_m: f64,
    /// Wavelength along the centre line, m; rounded so that a lap has a whole number of waves.
    pub length_m: f64,
    /// Phase at the start of the centre line, rad.
    pub phase_rad: f64,
}

/// Differences between the true world and its model.
#[derive(Clone, Debug, PartialEq)]
pub struct WorldPlan {
    /// Groups of the track that are present.
    pub groups: BTreeSet<Group>,
    /// Unmodelled undulation of the ground.
    pub undulation: Option<Undulation>,
    /// Scale of the other cars' bodies about the centre of the bottom of their box: length, width, height.
    pub car_scale: [f64; 3],
    /// Shift of the other cars' bodies relative to their boxes, m: forward, left, up.
    pub car_shift_m: [f64; 3],
    /// Roll and pitch of the other cars relative to their modelled attitude, rad: mean and standard deviation of each.
    pub car_tilt: [[f64; 2]; 2],
}

impl Default for WorldPlan {
    fn default() -> Self {
        WorldPlan {
            groups: Group::ALL.into_iter().collect(),
            undulation: None,
            car_scale: [1.0; 3],
            car_shift_m: [0.0; 3],
            car_tilt: [[0.0; 2]; 2],
        }
    }
}
