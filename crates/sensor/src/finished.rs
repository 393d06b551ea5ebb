//! Finished data sets on which effects act: the clouds of any simulator, frame by frame.

use crate::attributes;
use crate::cloud_scan::{CloudReader, Surfaces};
use crate::directions::{Kind, SensorScan, kind_of, split_by_sensor};
use crate::effects::{EffectList, FrameContext, LabelledCar, Need};
use crate::material::MaterialTable;
use crate::motion::{GroundPoint, OwnMotion, SeenVelocity, Standing, own_motion, seen_velocity, times_s};
use crate::rig::Rig;
use crate::scan::{Echo, Scan};
use data::Presence as _;
use data::{Cloud, DataError, Dataset, Frame, PointColumns};
use geometry::Box3;
use nalgebra::Vector3;
use rayon::prelude::*;
use std::collections::BTreeSet;

/// Frames from which scan patterns are estimated.
const PATTERN_FRAMES: usize = 10;

/// Time between frames whose ids are no numbers, s.
const FRAME_S: f64 = 0.05;

/// Name of the random number streams.
pub(crate) const STREAM: &str = "resim";

/// A finished data set and what is known of its points.
pub struct FinishedDataset<'a> {
    dataset: &'a Dataset,
    rig: Rig,
    ids: Vec<String>,
    reader: CloudReader,
    materials: MaterialTable,
    described: bool,
    surfaces: Surfaces,
    times: Option<Vec<f64>>,
    motions: Option<Vec<FrameMotion>>,
}

/// An effect of a list that cannot be applied.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// Its place in the list.
    pub index: usize,
    /// Its kind.
    pub kind: &'static str,
    /// What it lacks and how to give it.
    pub why: String,
}

/// Motion in one frame.
#[derive(Clone, Debug)]
struct FrameMotion {
    own: OwnMotion,
    own_is_known: bool,
    /// Velocities of the labelled objects.
    seen: Vec<Option<SeenVelocity>>,
}

impl<'a> FinishedDataset<'a> {
    /// Reads what `effects` need of a data set. Without `rig` the rig of the data set is taken, or one sensor at the
    /// origin of the clouds.
    ///
    /// # Errors
    /// Files that cannot be read, and a data set without frames.
    pub fn open(dataset: &'a Dataset, rig: Option<&Rig>, effects: &EffectList) -> Result<Self, DataError> {
        let rig = match (rig, &dataset.config.rig) {
            (Some(rig), _) => rig.clone(),
            (None, Some(path)) => Rig::read(path)?,
            (None, None) => Rig::single(),
        };
        let ids = dataset.all_ids()?;
        let some: Vec<&String> = pattern_frames(ids.len()).map(|at| &ids[at]).collect();
        let clouds: Vec<Cloud> = some.par_iter().map(|id| dataset.load_cloud(id)).collect::<Result<_, _>>()?;
        let reader = CloudReader::new(&rig, &clouds);
        let described = ids.first().is_some_and(|id| attributes::path(&dataset.config.root, id).may_be_file());
        let materials =
            if described { attributes::read_materials(&dataset.config.root)? } else { MaterialTable::default() };
        let rate_hz = rig.sensors.first().map_or(20.0, |s| s.rate_hz);
        let times = times_s(&ids, rate_hz);
        let mut set = FinishedDataset {
            dataset,
            rig,
            ids,
            reader,
            materials,
            described,
            surfaces: effects.surfaces(),
            times,
            motions: None,
        };
        let of_motion = |n: &Need| matches!(n, Need::Motion | Need::SeenMotion);
        let moves = |e: &crate::Effect| e.model().needs().is_some_and(|needs| needs.iter().any(of_motion));
        if effects.effects.iter().any(moves) {
            set.motions = set.find_motions()?;
        }
        Ok(set)
    }

    /// The same set for frames with these effects. What they do not read is not looked for in clouds without
    /// attributes, and is not known in the scans that [`Self::frames`] returns. The clouds keep their bits.
    #[must_use]
    pub fn for_effects(self, effects: &EffectList) -> Self {
        FinishedDataset { reader: self.reader.reading(effects.reads()), ..self }
    }

    /// The sensors.
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// The materials of the attributes.
    pub fn materials(&self) -> &MaterialTable {
        &self.materials
    }

    /// Whether attributes describe the points.
    pub fn is_described(&self) -> bool {
        self.described
    }

    /// Ids of all frames in order.
    pub fn ids(&self) -> &[String] {
        &self.ids
    }

    /// Effects of the list that cannot be applied to this data set.
    pub fn refusals(&self, effects: &EffectList) -> Vec<Refusal> {
        refusals_of(effects, &self.rig, &self.known())
    }

    fn known(&self) -> BTreeSet<Need> {
        use Need::{Cars, Grid, Incidence, Material, Motion, Reflectivity, Row, SeenMotion, Time};
        let mut known = if self.described {
            [Cars, Grid, Incidence, Material, Reflectivity, Row, Time].into()
        } else {
            let channels = if self.dataset.config.points == PointColumns::Xyz { 3 } else { 4 };
            self.reader.known(channels, &self.surfaces)
        };
        if let Some(motions) = &self.motions {
            known.insert(SeenMotion);
            known.extend(motions.iter().any(|m| m.own_is_known).then_some(Motion));
        }
        known
    }

    /// One frame with the effects applied. Returns it with what is known about its points. Points that no effect
    /// touches keep their bytes.
    ///
    /// # Errors
    /// An id that the data set does not have, files that cannot be read, attributes that do not fit the cloud.
    pub fn frame(&self, effects: &EffectList, seed: u64, id: &str) -> Result<(Frame, Scan), DataError> {
        let [made] = self.frames(effects, [seed], id)?;
        Ok(made)
    }

    /// The same for several random seeds.
    ///
    /// # Errors
    /// As for one.
    pub fn frames<const N: usize>(
        &self,
        effects: &EffectList,
        seeds: [u64; N],
        id: &str,
    ) -> Result<[(Frame, Scan); N], DataError> {
        let index = self
            .ids
            .iter()
            .position(|own| own == id)
            .ok_or_else(|| DataError::file(&self.dataset.config.root, format!("has no frame {id}")))?;
        let frame = self.dataset.load(id)?;
        let before = self.scan(&frame)?;
        let shown = self.cars(index, &frame);
        Ok(seeds.map(|seed| self.with_effects(effects, seed, index, &frame, &before, &shown)))
    }

    /// A frame with effects; `before` is its scan.
    fn with_effects(
        &self,
        effects: &EffectList,
        seed: u64,
        index: usize,
        frame: &Frame,
        before: &Scan,
        shown: &[LabelledCar],
    ) -> (Frame, Scan) {
        let (mut frame, mut scan, mut cars) = (frame.clone(), before.clone(), shown.to_vec());
        let own = self.motions.as_ref().map(|motions| motions[index].own);
        let context = FrameContext {
            seed,
            set: STREAM,
            index: index as u64,
            time_s: self.times.as_ref().map_or(index as f64 * FRAME_S, |times| times[index]),
            rig: &self.rig,
            materials: &self.materials,
            ego_velocity: own.map_or([0.0; 3], |m| m.velocity_m_s.into()),
            ego_turn_rate: own.map_or([0.0; 3], |m| m.turn_rate_rad_s.into()),
            cars: shown,
            sensors: Some(self.reader.sensors()),
            scene: None,
            world_x_rad: 0.0,
        };
        effects.on_cloud(&mut scan, &context);
        effects.on_labels(&mut cars, &context);
        frame.cloud = cloud_of(&scan, before, &frame.cloud);
        for (object, car) in frame.objects.iter_mut().zip(&cars) {
            object.bbox = car.label;
        }
        (frame, scan)
    }

    /// A frame as a scan.
    fn scan(&self, frame: &Frame) -> Result<Scan, DataError> {
        let beside = attributes::path(&self.dataset.config.root, &frame.id);
        if !beside.may_be_file() {
            return Ok(self.reader.scan(&frame.cloud, &self.surfaces));
        }
        let mut scan = attributes::read(&beside, &self.rig)?;
        if scan.echoes.len() != frame.cloud.len() {
            let message = format!("has {} rows, but the cloud has {} points", scan.echoes.len(), frame.cloud.len());
            return Err(DataError::file(&beside, message));
        }
        for (echo, point) in scan.echoes.iter_mut().zip(frame.cloud.points()) {
            echo.intensity = point.get(3).copied().unwrap_or(0.0);
        }
        scan.echoes.extend(self.reader.empty_shots(&split_by_sensor(&frame.cloud, &self.rig)));
        Ok(scan)
    }

    /// The labelled objects of a frame, with their velocities over ground where they are known.
    fn cars(&self, index: usize, frame: &Frame) -> Vec<LabelledCar> {
        let motion = self.motions.as_ref().map(|motions| &motions[index]);
        let velocity = |number: usize, bbox: &Box3| {
            let Some(FrameMotion { own, seen, .. }) = motion else { return [0.0; 3] };
            let Some(Some(seen)) = seen.get(number) else { return [0.0; 3] };
            match seen.speed_m_s {
                Some(speed) => [speed * bbox.yaw_rad.cos(), speed * bbox.yaw_rad.sin(), 0.0],
                None => (seen.relative_m_s + own.velocity_at(&Vector3::from(bbox.center))).into(),
            }
        };
        let car = |(number, object): (usize, &data::Object)| LabelledCar {
            number,
            true_box: object.bbox,
            label: object.bbox,
            velocity: velocity(number, &object.bbox),
        };
        frame.objects.iter().enumerate().map(car).collect()
    }

    /// Motion in all frames; `None` where it cannot be estimated in most of them.
    fn find_motions(&self) -> Result<Option<Vec<FrameMotion>>, DataError> {
        let Some(times) = &self.times else { return Ok(None) };
        let read = |id: &String| {
            let frame = self.dataset.load(id)?;
            let boxes: Vec<Box3> = frame.objects.iter().map(|o| o.bbox).collect();
            Ok((self.standing(&frame.cloud, &boxes), boxes))
        };
        let frames: Vec<_> = self.ids.par_iter().map(read).collect::<Result<_, DataError>>()?;
        let (standing, boxes): (Vec<_>, Vec<Vec<Box3>>) = frames.into_iter().unzip();
        let driven = own_motion(standing, times);
        let of_frame = |g: usize| boxes[g].clone();
        let motion = |(f, own): (usize, Option<OwnMotion>)| FrameMotion {
            own_is_known: own.is_some(),
            own: own.unwrap_or(OwnMotion::ahead(0.0)),
            seen: boxes[f].iter().map(|b| seen_velocity(&of_frame, times, f, b, &driven.to_next)).collect(),
        };
        Ok(Some(driven.at.iter().copied().enumerate().map(motion).collect()))
    }

    /// What of a cloud stands still.
    fn standing(&self, cloud: &Cloud, boxes: &[Box3]) -> Standing {
        let scans: Vec<SensorScan> = split_by_sensor(cloud, &self.rig);
        let (mut returns, mut ground) = (Vec::new(), Vec::new());
        for (number, scan) in scans.iter().enumerate() {
            let around = crate::directions::Surroundings::new(self.reader.sensors(), number, scan);
            for i in 0..scan.len() {
                let (azimuth, elevation) = (scan.azimuth_rad[i], scan.elevation_rad[i]);
                let seen = around.look(azimuth, elevation, Some(i as u32));
                let range_m = f64::from(scan.range_m[i]);
                let place = around.place(&around.direction(azimuth, elevation), range_m);
                let edge = seen.surface.is_none() && seen.near_far_m[1] > 0.0;
                if edge && kind_of(boxes, place, None) == Kind::Standing {
                    returns.push((Vector3::from(place), range_m));
                }
                let normal = seen.surface.map(|(_, normal)| normal);
                if let Some(normal) = normal.filter(|n| kind_of(boxes, place, Some(n.z)) == Kind::Ground) {
                    ground.push(GroundPoint { place: place.into(), normal });
                }
            }
        }
        Standing::new(returns, boxes, ground)
    }
}

/// Effects of a list that cannot be applied to finished clouds of a rig of which this is known.
pub(crate) fn refusals_of(effects: &EffectList, rig: &Rig, known: &BTreeSet<Need>) -> Vec<Refusal> {
    let mut refused = Vec::new();
    for (index, effect) in effects.effects.iter().enumerate() {
        let why = match effect.model().needs() {
            None => {
                Some("changes what rays meet, which a finished cloud does not tell: use it with `simulate`".to_owned())
            }
            Some(needs) => why_not(needs.iter().filter(|n| !known.contains(n)).copied().collect()),
        };
        let why = why.or_else(|| effect.strange_to(rig));
        refused.extend(why.map(|why| Refusal { index, kind: effect.kind(), why }));
    }
    refused
}

/// Why effects with these needs cannot be applied; `None` without needs.
fn why_not(missing: Vec<Need>) -> Option<String> {
    let lacks: Vec<&str> = missing.iter().map(|n| n.description()).collect();
    let mut how: Vec<&str> = missing.iter().map(|n| n.how_to_give()).collect();
    how.dedup();
    (!missing.is_empty())
        .then(|| format!("needs {}, which this data set does not tell; {}", lacks.join(" and "), how.join("; ")))
}

/// The clouds of a data set, by number, in which its scan patterns are found.
pub fn pattern_frames(frames: usize) -> impl Iterator<Item = usize> {
    (0..frames).step_by(frames.div_ceil(PATTERN_FRAMES).max(1))
}

/// The cloud of a scan after effects. Points whose echo is as it was `before` are those of `source` to the bit.
pub(crate) fn cloud_of(scan: &Scan, before: &Scan, source: &Cloud) -> Cloud {
    let mut cloud = Cloud::new(source.channels);
    cloud.values.reserve(source.values.len());
    let same = |a: &Echo, b: &Echo| a.point() == b.point() && a.intensity == b.intensity;
    for echo in scan.returns() {
        let number = echo.source as usize;
        let kept = before.echoes.get(number).is_some_and(|b| b.source == echo.source && same(b, echo));
        if kept {
            let at = number * source.channels;
            cloud.values.extend_from_slice(&source.values[at..at + source.channels]);
        } else {
            let [x, y, z] = echo.point();
            cloud.values.extend_from_slice(&[x, y, z, echo.intensity][..source.channels]);
        }
    }
    cloud
}
