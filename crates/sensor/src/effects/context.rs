//! What effects are told of a frame, and where their random numbers come from.

use crate::material::MaterialTable;
use crate::object::Group;
use crate::ray_caster::RayCaster;
use crate::rig::Rig;
use data::{Stream, stream};
use geometry::Box3;
use std::collections::BTreeSet;

/// Something that must be known of a finished cloud for an effect to act on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Need {
    /// Normals and angles of incidence.
    Incidence,
    /// How much the surfaces reflect.
    Reflectivity,
    /// Which material was hit.
    Material,
    /// Rows of the pattern.
    Row,
    /// Rows and columns of the pattern.
    Grid,
    /// Times of the shots.
    Time,
    /// Where the other cars are.
    Cars,
    /// How the own car and the others move.
    Motion,
}

impl Need {
    /// In words, for messages.
    pub fn words(self) -> &'static str {
        match self {
            Need::Incidence => "the angle of incidence",
            Need::Reflectivity => "the reflectivity of surfaces",
            Need::Material => "the material of surfaces",
            Need::Row => "the row of each point in the sensor's pattern",
            Need::Grid => "the row and column of each point in the sensor's pattern",
            Need::Time => "the time of each shot",
            Need::Cars => "boxes of the cars",
            Need::Motion => "the motion of the cars",
        }
    }
}

/// Another car in a frame, in the cloud's frame.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelledCar {
    /// Number of the car: the same in all frames of a run.
    pub number: usize,
    /// Where it is.
    pub true_box: Box3,
    /// Where its label says that it is.
    pub label: Box3,
    /// Its velocity over the ground, m/s.
    pub velocity: [f64; 3],
}

/// What is known of a frame besides its scan.
#[derive(Clone, Copy)]
pub struct FrameContext<'a> {
    /// Seed of the data set.
    pub seed: u64,
    /// Name of the data set.
    pub set: &'a str,
    /// Number of the frame.
    pub index: u64,
    /// Time since the beginning of the first run, s.
    pub time_s: f64,
    /// The sensors.
    pub rig: &'a Rig,
    /// The materials.
    pub materials: &'a MaterialTable,
    /// Velocity of the car that carries the sensors, m/s, cloud's frame.
    pub ego_velocity: [f64; 3],
    /// Its rate of turn, rad/s, cloud's frame.
    pub ego_turn_rate: [f64; 3],
    /// The other cars.
    pub cars: &'a [LabelledCar],
    /// To ask what further rays meet; `None` for a finished cloud.
    pub scene: Option<&'a dyn RayCaster>,
    /// Direction of the world's +x axis in the cloud's frame, rad, counter-clockwise from +x.
    pub world_x_rad: f64,
}

/// Where the random numbers of one effect come from.
#[derive(Clone, Debug)]
pub struct Draws {
    seed: u64,
    purpose: String,
    frame: u64,
}

impl Draws {
    /// The streams of an effect in a frame.
    pub fn new(seed: u64, purpose: String, frame: u64) -> Draws {
        Draws { seed, purpose, frame }
    }

    /// Numbers of this frame alone.
    pub fn of_frame(&self) -> Stream {
        stream(self.seed, &self.purpose, 1, self.frame)
    }

    /// Numbers that are the same in every frame; another `number`, other numbers.
    pub fn of_set(&self, number: u64) -> Stream {
        stream(self.seed, &self.purpose, 0, number)
    }
}

/// A waviness of the ground that is not in the plans: `h(way) = amplitude * sin(2 pi way / length + phase)`, m, of the surface and all that
/// stands on it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Undulation {
    /// Greatest height, m.
    pub amplitude_m: f64,
    /// Length of a wave along the centre line, m; rounded so that whole waves fit into a lap.
    pub length_m: f64,
    /// Where it begins, rad.
    pub phase_rad: f64,
}

/// What stands where.
#[derive(Clone, Debug, PartialEq)]
pub struct WorldPlan {
    /// Groups of the track that are there.
    pub groups: BTreeSet<Group>,
    /// Waves of the ground that the plans do not have.
    pub undulation: Option<Undulation>,
    /// Stretches the cars about the middle of their box's bottom: length, width, height.
    pub car_scale: [f64; 3],
    /// Moves the cars' bodies against where they are said to be, m: forward, left, up.
    pub car_shift_m: [f64; 3],
    /// Turns the other cars against the road: mean and standard deviation of roll and pitch, rad.
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
