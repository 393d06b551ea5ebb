//! The frames of both data sets, read once and held in memory for every pairing.

use super::gaps::mixed_per_rad;
use super::matching::{Matched, match_directions};
use super::row_edges::{RowEdges, edges_of};
use super::second::drop_second;
use crate::error::DiagnoseError;
use data::{Cloud, Dataset, Object};
use sensor::Rig;
use sensor::directions::{SensorScan, Sensors, split_by_sensor};
use std::sync::{Arc, OnceLock};

/// One side of a frame: its returns by sensor (12 bytes a return) and its labelled objects.
#[derive(Clone, Debug)]
pub struct SideFrame {
    /// Returns of each sensor.
    pub scans: Vec<SensorScan>,
    /// Labelled objects.
    pub objects: Vec<Object>,
    /// Second returns of shots; the scans do not hold them.
    pub second: usize,
}

/// Which side of a pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PairSide {
    /// Measured.
    Measured,
    /// Simulated.
    Simulated,
}

/// The frames that both data sets have.
pub struct Recordings<'a> {
    datasets: [&'a Dataset; 2],
    rig: &'a Rig,
    frames: Vec<Held>,
}

/// What is held of a frame, each part from its first use on.
struct Held {
    id: String,
    sides: [OnceLock<Arc<SideFrame>>; 2],
    matched: OnceLock<Vec<Matched>>,
    edges: OnceLock<[RowEdges; 2]>,
}

impl SideFrame {
    /// From a cloud and its objects. Shots keep the nearer one of two returns.
    pub fn new(cloud: &Cloud, objects: Vec<Object>, rig: &Rig) -> Self {
        let mut scans = split_by_sensor(cloud, rig);
        let second = scans.iter_mut().map(drop_second).sum();
        SideFrame { scans, objects, second }
    }
}

impl<'a> Recordings<'a> {
    /// Frames by their ids; nothing is read yet.
    pub fn new(measured: &'a Dataset, simulated: &'a Dataset, rig: &'a Rig, ids: Vec<String>) -> Self {
        let held = |id| Held { id, sides: Default::default(), matched: OnceLock::new(), edges: OnceLock::new() };
        Recordings { datasets: [measured, simulated], rig, frames: ids.into_iter().map(held).collect() }
    }

    /// Some of the frames, by their numbers here, with another simulated side; and with another measured side, where
    /// one is given.
    pub fn with_sides(
        &self,
        which: &[usize],
        measured: Option<&[Arc<SideFrame>]>,
        simulated: &[Arc<SideFrame>],
    ) -> Result<Recordings<'a>, DiagnoseError> {
        let of_frame = |(at, &frame): (usize, &usize)| {
            let measured = match measured {
                Some(others) => OnceLock::from(others[at].clone()),
                None => {
                    self.side(frame, PairSide::Measured)?;
                    self.frames[frame].sides[PairSide::Measured as usize].clone()
                }
            };
            let sides = [measured, OnceLock::from(simulated[at].clone())];
            Ok(Held { id: self.id(frame).into(), sides, matched: OnceLock::new(), edges: OnceLock::new() })
        };
        let frames = which.iter().enumerate().map(of_frame).collect::<Result<_, DiagnoseError>>()?;
        Ok(Recordings { datasets: self.datasets, rig: self.rig, frames })
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// No frame.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Id of a frame.
    pub fn id(&self, frame: usize) -> &str {
        &self.frames[frame].id
    }

    /// Keeps the frames of some ids, in their order.
    pub fn retain(&mut self, keep: impl Fn(&str) -> bool) {
        self.frames.retain(|f| keep(&f.id));
    }

    /// One side of a frame.
    pub fn side(&self, frame: usize, side: PairSide) -> Result<&SideFrame, DiagnoseError> {
        let held = &self.frames[frame];
        let cell = &held.sides[side as usize];
        if let Some(side) = cell.get() {
            return Ok(side);
        }
        let (cloud, objects) = load(self.datasets[side as usize], &held.id)?;
        let read = SideFrame::new(&cloud, objects, self.rig);
        Ok(cell.get_or_init(|| Arc::new(read)))
    }

    /// Which returns of a frame have a counterpart, by sensor. Shots are matched by the directions in which they were
    /// sent, whatever is corrected later.
    pub fn matched(&self, frame: usize, sensors: &Sensors) -> Result<&[Matched], DiagnoseError> {
        let [measured, simulated] = [self.side(frame, PairSide::Measured)?, self.side(frame, PairSide::Simulated)?];
        let of_sensor = |k: usize| {
            let closes = sensors.rig.sensors[k].is_full_circle();
            match_directions(&measured.scans[k], &simulated.scans[k], &sensors.patterns[k], closes)
        };
        let all = || (0..sensors.rig.sensors.len()).map(of_sensor).collect();
        Ok(self.frames[frame].matched.get_or_init(all))
    }

    /// Edges in the rows of the measured and of the simulated side of a frame, as they were recorded.
    pub fn edges(&self, frame: usize, sensors: &Sensors) -> Result<&[RowEdges; 2], DiagnoseError> {
        let sides = [self.side(frame, PairSide::Measured)?, self.side(frame, PairSide::Simulated)?];
        let both = || sides.map(|side| edges_of(&side.scans, sensors));
        Ok(self.frames[frame].edges.get_or_init(both))
    }

    /// Share of the simulated returns of a frame that beams would mix, see [`mixed_per_rad`].
    pub fn mixed_per_rad(&self, frame: usize, sensors: &Sensors) -> Result<f64, DiagnoseError> {
        Ok(mixed_per_rad(&self.side(frame, PairSide::Simulated)?.scans, sensors))
    }
}

/// Cloud and objects of a frame.
pub(crate) fn load(dataset: &Dataset, id: &str) -> Result<(Cloud, Vec<Object>), DiagnoseError> {
    let cloud = dataset.load_cloud(id)?;
    let lines = if dataset.has_labels() { dataset.labels(id)? } else { Vec::new() };
    Ok((cloud, dataset.objects(id, &lines)?))
}
