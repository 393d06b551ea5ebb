//! A prepared race that can be simulated frame by frame with any list of effects.

use super::config::{RaceConfig, SetConfig};
use super::files::ConfigFiles;
use super::frames::{FrameKey, choose};
use crate::SimulateError;
use crate::auto_label::{AutoLabel, Refine, refine_to_faces, refine_to_shape};
use crate::frame_scene::FrameScene;
use crate::mesh::Mesh;
use crate::race_car::race_car;
use crate::scenario::{FRAME_S, Motion, Run};
use crate::shape_field::ShapeField;
use crate::track::{CentreLine, Track, las_vegas};
use crate::world::{CarShape, World};
use data::{Cloud, DataError, Frame, Object, stream};
use geometry::{Box3, move_box, yaw_rad};
use nalgebra::UnitQuaternion;
use rand_distr::{Distribution, StandardNormal};
use sensor::beams::Beams;
use sensor::car::car_box;
use sensor::effects::{EffectList, FrameContext, LabelledCar, WorldPlan};
use sensor::material::MaterialTable;
use sensor::rig::Rig;
use sensor::scan::Scan;
use std::path::Path;
use std::sync::OnceLock;

/// State shared by all data sets of a race.
#[derive(Clone, Debug)]
pub struct Simulator {
    /// Its configuration.
    pub config: RaceConfig,
    /// The rig at the configured resolution.
    pub rig: Rig,
    /// Materials by index.
    pub materials: MaterialTable,
    /// The track.
    pub track: Track,
    /// The runs.
    pub runs: Vec<Run>,
    keys: Vec<FrameKey>,
    pub(super) car: Mesh,
    beams: Beams,
    ideal: Surroundings,
    /// Surface of the car as modelled, for automatic labels; made when it is needed.
    shape: OnceLock<ShapeField>,
}

/// Static surroundings.
#[derive(Clone, Debug)]
struct Surroundings {
    world: World,
    car: CarShape,
}

impl Surroundings {
    fn new(track: &Track, car: &Mesh, plan: &WorldPlan) -> Surroundings {
        let groups: Vec<_> = plan.groups.iter().copied().collect();
        let world = World::new(&track.mesh(&groups, plan.undulation));
        let bbox = car_box();
        let foot = [bbox.center[0], bbox.center[1], bbox.z_range().0];
        let place =
            |v: [f64; 3]| std::array::from_fn(|k| foot[k] + (v[k] - foot[k]) * plan.car_scale[k] + plan.car_shift_m[k]);
        Surroundings { world, car: CarShape::new(&car.clone().mapped(place)) }
    }
}

/// A data set: its world and its effects.
#[derive(Clone, Debug)]
pub struct PreparedSet {
    /// Effect lists with the name of the random stream of each.
    pub lists: Vec<(String, EffectList)>,
    /// Settings of automatic labels; exact labels if `None`.
    pub auto_label: Option<AutoLabel>,
    plan: WorldPlan,
    surroundings: Surroundings,
}

/// A simulated frame.
#[derive(Clone, Debug, PartialEq)]
pub struct SimulatedFrame {
    /// Cloud and labels.
    pub frame: Frame,
    /// The returns of the cloud, in the same order.
    pub scan: Scan,
    /// True boxes of the labelled cars, in label order.
    pub true_boxes: Vec<Box3>,
}

impl SimulatedFrame {
    /// Its objects with the true boxes in the place of the labels.
    pub fn with_true_boxes(&self) -> Frame {
        let labelled = self.frame.objects.iter().zip(&self.true_boxes);
        let objects = labelled.map(|(object, bbox)| Object { bbox: rounded(bbox), ..object.clone() }).collect();
        Frame { id: self.frame.id.clone(), cloud: Cloud::default(), objects }
    }
}

impl Simulator {
    /// Reads all files of the configuration and generates the race.
    pub fn new(config: RaceConfig, files: &ConfigFiles) -> Result<Simulator, SimulateError> {
        let rig = config.rig(files)?;
        let materials = MaterialTable::with(&config.materials).map_err(|e| e.below("materials"))?;
        let line = match &config.track.file {
            Some(file) => CentreLine::read(&files.folder().join(file))?,
            None => las_vegas(),
        };
        if !line.turns_left() {
            let path = config.track.file.clone().unwrap_or_default();
            let message = "turns to the right; list its points the other way round, and swap the widths";
            return Err(DataError::file(&files.folder().join(path), message).into());
        }
        let track = Track { line, seed: config.track.seed };
        let runs = if config.runs.is_empty() {
            config.race.runs(&track, config.seed)
        } else {
            let read = |run: &crate::scenario::RunFiles| run.read(&files.folder(), Some(&track));
            config.runs.iter().map(read).collect::<Result<Vec<_>, _>>()?
        };
        let car = match &config.car {
            Some(file) => file.read(&files.folder(), &materials)?,
            None => race_car(),
        };
        let keys = choose(&runs, config.frames, (config.split, config.split_shares), config.seed)?;
        let beams = Beams::of(&rig);
        let ideal = Surroundings::new(&track, &car, &WorldPlan::default());
        Ok(Simulator { config, rig, materials, track, runs, keys, car, beams, ideal, shape: OnceLock::new() })
    }

    fn shape(&self) -> &ShapeField {
        self.shape.get_or_init(|| ShapeField::new(&self.car, car_box().center))
    }

    /// The selected frames, in ascending order.
    pub fn keys(&self) -> &[FrameKey] {
        &self.keys
    }

    /// The frame with this id.
    pub fn key(&self, id: &str) -> Option<&FrameKey> {
        self.keys.iter().find(|key| key.id() == id)
    }

    /// Number of shots per scan.
    pub fn shots(&self) -> usize {
        self.beams.shots()
    }

    /// Prepares a data set of the configuration.
    pub fn set(&self, set: &SetConfig, files: &ConfigFiles) -> Result<PreparedSet, SimulateError> {
        Ok(self.prepare(self.config.effects_of(set, files)?, set.auto_label))
    }

    /// Prepares a data set with these effect lists; labels are exact unless `auto_label` is given.
    pub fn prepare(&self, lists: Vec<(String, EffectList)>, auto_label: Option<AutoLabel>) -> PreparedSet {
        let mut plan = WorldPlan::default();
        lists.iter().for_each(|(_, list)| list.on_world(&mut plan));
        let surroundings = Surroundings::new(&self.track, &self.car, &plan);
        PreparedSet { lists, auto_label, plan, surroundings }
    }

    /// Motion of the ego vehicle and of the other cars at the middle of a frame's scan.
    pub fn motions(&self, key: &FrameKey) -> Result<(Motion, Vec<Motion>), SimulateError> {
        let run = &self.runs[key.run];
        let time_s = run.time_s(key.frame);
        let missing =
            || DataError::file(Path::new("trajectories"), format!("no state at {time_s:.3} s of run {}", key.run));
        let ego = run.ego.at(time_s).ok_or_else(missing)?;
        let cars = run.rivals.iter().map(|car| car.at(time_s)).collect::<Option<Vec<_>>>().ok_or_else(missing)?;
        Ok((ego, cars))
    }

    /// Ray casting scene of a frame for a data set.
    pub fn scene<'a>(&'a self, set: &'a PreparedSet, key: &FrameKey) -> Result<FrameScene<'a>, SimulateError> {
        let (ego, mut cars) = self.motions(key)?;
        self.tilt(set, key, &mut cars);
        Ok(self.scene_of(&set.surroundings, ego, &cars))
    }

    fn scene_of<'a>(&'a self, surroundings: &'a Surroundings, ego: Motion, cars: &[Motion]) -> FrameScene<'a> {
        FrameScene::new(&surroundings.world, &surroundings.car, &self.materials, ego, cars)
    }

    fn tilt(&self, set: &PreparedSet, key: &FrameKey, cars: &mut [Motion]) {
        let [roll, pitch] = set.plan.car_tilt;
        if set.plan.car_tilt == [[0.0; 2]; 2] {
            return;
        }
        let name = set.lists.last().map_or("", |(name, _)| name);
        let mut random = stream(self.config.seed, &format!("{name}/tilt of cars"), 0, key.number as u64);
        for car in cars {
            let [a, b]: [f64; 2] = std::array::from_fn(|_| StandardNormal.sample(&mut random));
            car.pose.rotation *= UnitQuaternion::from_euler_angles(roll[0] + roll[1] * a, pitch[0] + pitch[1] * b, 0.0);
        }
    }

    /// The other cars of a frame with exact labels, in the cloud frame.
    pub fn cars(&self, key: &FrameKey) -> Result<Vec<LabelledCar>, SimulateError> {
        let (ego, cars) = self.motions(key)?;
        let cloud_from_world = ego.pose.inverse();
        let labelled = |(number, car): (usize, &Motion)| {
            let true_box = move_box(&(cloud_from_world * car.pose), &car_box()).with_wrapped_yaw();
            let velocity = (cloud_from_world.rotation * car.velocity).into();
            LabelledCar { number, true_box, label: true_box, velocity }
        };
        Ok(cars.iter().enumerate().map(labelled).collect())
    }

    /// Which cars of a frame are labelled: those in range that are hit in a simulation without effects, so that all
    /// data sets of a race label the same cars.
    pub fn labelled(&self, key: &FrameKey) -> Result<Vec<bool>, SimulateError> {
        let (ego, motions) = self.motions(key)?;
        let scene = self.scene_of(&self.ideal, ego, &motions);
        let returns = scene.returns_of_cars(&self.beams, motions.len());
        let in_range =
            |car: &LabelledCar| car.true_box.center[0].hypot(car.true_box.center[1]) <= self.config.label_range_m;
        let cars = self.cars(key)?;
        Ok(cars.iter().zip(returns).map(|(car, n)| in_range(car) && n >= self.config.label_points).collect())
    }

    /// Simulates a frame of a data set.
    pub fn make(&self, set: &PreparedSet, key: &FrameKey) -> Result<SimulatedFrame, SimulateError> {
        let mut cars = self.cars(key)?;
        let (ego, mut motions) = self.motions(key)?;
        let exact = cars.clone();
        self.tilt(set, key, &mut motions);
        let scene = self.scene_of(&set.surroundings, ego, &motions);
        let cloud_from_world = ego.pose.rotation.inverse();
        let context = FrameContext {
            seed: self.config.seed,
            set: "",
            index: key.number as u64,
            time_s: key.number as f64 * FRAME_S,
            rig: &self.rig,
            materials: &self.materials,
            ego_velocity: (cloud_from_world * ego.velocity).into(),
            ego_turn_rate: (cloud_from_world * ego.turn_rate).into(),
            cars: &exact,
            sensors: None,
            scene: Some(&scene),
            world_x_rad: -yaw_rad(&ego.pose),
        };
        let mut beams = self.beams.clone();
        set.lists.iter().for_each(|(name, list)| list.on_beams(&mut beams, &FrameContext { set: name, ..context }));
        let mut scan = scene.scan(&beams);
        set.lists.iter().for_each(|(name, list)| list.on_scan(&mut scan, &FrameContext { set: name, ..context }));
        scan.crop(self.config.crop_m as f32);
        let cloud = scan.cloud();

        if let Some(auto) = &set.auto_label {
            self.record(auto, key, &mut cars)?;
        }
        set.lists.iter().for_each(|(name, list)| list.on_labels(&mut cars, &FrameContext { set: name, ..context }));
        let labelled = self.labelled(key)?;
        cars.retain(|car| labelled[car.number]);
        if let Some(auto) = &set.auto_label {
            for car in &mut cars {
                car.label = match auto.refine {
                    Refine::None => car.label,
                    Refine::Faces => refine_to_faces(&cloud, &car.label),
                    Refine::Shape => refine_to_shape(&cloud, &car.label, self.shape(), auto.position_std_m),
                };
            }
        }
        let object = |car: &LabelledCar| Object {
            class: self.config.class.clone(),
            bbox: rounded(&car.label),
            truncation: Some(0.0),
            occlusion: Some(0),
            image_box: None,
        };
        let objects = cars.iter().map(object).collect();
        let true_boxes = cars.iter().map(|car| car.true_box).collect();
        Ok(SimulatedFrame { frame: Frame { id: key.id(), cloud, objects }, scan, true_boxes })
    }

    /// Replaces exact labels by automatic ones.
    fn record(&self, auto: &AutoLabel, key: &FrameKey, cars: &mut [LabelledCar]) -> Result<(), SimulateError> {
        let run = &self.runs[key.run];
        let purpose = format!("{}/run {}", self.config.name, key.run);
        let time_s = run.time_s(key.frame);
        let boxes = auto.boxes(&run.ego, &run.rivals, time_s, self.config.seed, &purpose);
        for (car, label) in cars.iter_mut().zip(boxes) {
            car.label = label.ok_or_else(|| {
                DataError::file(Path::new("trajectories"), format!("no record around {time_s:.3} s of run {}", key.run))
            })?;
        }
        Ok(())
    }
}

/// Rounds to 1 mm and 0.1 mrad, the precision of label files.
fn rounded(bbox: &Box3) -> Box3 {
    let round = |v: f64, steps: f64| (v * steps).round() / steps;
    Box3 {
        center: bbox.center.map(|v| round(v, 1e3)),
        size: bbox.size,
        yaw_rad: round(bbox.with_wrapped_yaw().yaw_rad, 1e4),
    }
}
