//! Both sides of an unpaired comparison, each frame by itself.

use crate::channels::mask::{DirectionCell, direction_cell, neighbours};
use crate::channels::returns::OWN_CAR_M;
use crate::error::DiagnoseError;
use crate::inference::evenly_spread;
use crate::pairing::{
    FrameAlone, FramePair, Ray, RowEdges, SideFrame, Surface, alone, frame_alone, has_no_point, in_order, load,
    round_ranges, thin,
};
use data::{Cloud, Dataset, Object};
use rayon::prelude::*;
use sensor::Rig;
use sensor::directions::{EDGE_M, SensorScan, Sensors};
use std::collections::{BTreeMap, BTreeSet};

/// Frames of each side, at most. More do not improve findings, and time stays bounded.
const MOST_FRAMES: usize = 200;

/// Frames that a scan pattern is estimated from.
const PATTERN_FRAMES: usize = 10;

/// Standard deviations of the usual noise that are added to the distance from which on a neighbour is beyond an edge.
const NOISE_AT_EDGES: f64 = 4.0;

/// The frames of one side.
pub(super) struct Side<'a> {
    dataset: &'a Dataset,
    rig: &'a Rig,
    /// Ids of the frames that are used, in order.
    pub(super) ids: Vec<String>,
    /// Scan patterns.
    pub(super) sensors: Sensors,
}

impl<'a> Side<'a> {
    /// The frames of a data set, or of a split, that have points; at most `most` of them.
    pub(super) fn open(dataset: &'a Dataset, rig: &'a Rig, mut ids: Vec<String>) -> Result<Self, DiagnoseError> {
        let mut kept = Vec::new();
        for id in ids.drain(..) {
            if !has_no_point(dataset, &id)? {
                kept.push(id);
            }
        }
        let mut side =
            Side { dataset, rig, ids: kept, sensors: Sensors { rig: rig.clone(), patterns: vec![], edge_m: EDGE_M } };
        let some = side.spread(PATTERN_FRAMES);
        let frames = in_order(some.par_iter().map(|id| side.read(id)))?;
        let scans: Vec<&[SensorScan]> = frames.iter().map(|f| &f.scans[..]).collect();
        side.sensors = Sensors::find(rig, &scans);
        Ok(side)
    }

    /// So many of the ids, evenly spread.
    fn spread(&self, most: usize) -> Vec<String> {
        evenly_spread(&self.ids, most)
    }

    /// Keeps so many of the frames, evenly spread.
    pub(super) fn keep(&mut self, most: usize) {
        self.ids = self.spread(most.min(MOST_FRAMES));
    }

    fn read(&self, id: &str) -> Result<SideFrame, DiagnoseError> {
        let (cloud, objects) = load(self.dataset, id)?;
        Ok(SideFrame::new(&cloud, objects, self.rig))
    }

    /// A few frames by themselves.
    pub(super) fn some_frames(&self, how: &How) -> Result<Vec<FrameAlone>, DiagnoseError> {
        let some = self.spread(PATTERN_FRAMES);
        in_order(some.par_iter().enumerate().map(|(i, id)| Ok(self.alone(self.read(id)?, how, i))))
    }

    /// Every frame by itself; simulated ranges are rounded to a step where there is one.
    pub(super) fn frames(&self, how: &How, done: &(dyn Fn() + Sync)) -> Result<Vec<FrameAlone>, DiagnoseError> {
        in_order((0..self.ids.len()).into_par_iter().map(|i| {
            let frame = self.alone(self.read(&self.ids[i])?, how, i);
            done();
            Ok(frame)
        }))
    }

    /// A frame that was made anew.
    pub(super) fn remade(&self, cloud: &Cloud, objects: Vec<Object>, how: &How, number: usize) -> FrameAlone {
        self.alone(SideFrame::new(cloud, objects, self.rig), how, number)
    }

    fn alone(&self, mut side: SideFrame, how: &How, number: usize) -> FrameAlone {
        if let Some(step_m) = how.step_m {
            side.scans.iter_mut().for_each(|scan| round_ranges(scan, step_m));
        }
        let sensors = Sensors { edge_m: how.edge_m, ..self.sensors.clone() };
        let mut frame = frame_alone(&side, &sensors);
        for (k, rays) in [&mut frame.returns, &mut frame.shots].into_iter().enumerate() {
            thin(rays, how.kept, [number as u64, 2 + k as u64]);
        }
        frame
    }
}

/// How frames are looked at.
#[derive(Clone, Copy, Debug)]
pub(super) struct How {
    /// Step to which ranges are rounded, m.
    pub(super) step_m: Option<f64>,
    /// Distance across a plane from which on a neighbour belongs to another surface, m.
    pub(super) edge_m: f64,
    /// Returns, and shots, that are kept of a frame.
    pub(super) kept: usize,
}

/// Distance across a plane from which on a neighbour belongs to another surface, on both sides alike, m. Where one side
/// is noisy, the noise is no edge.
pub(super) fn edge_m(sides: [&[FrameAlone]; 2]) -> f64 {
    let usual = |frames: &[FrameAlone]| {
        let rays = frames.iter().flat_map(|f| &f.returns).filter(|r| r.roughness_m.is_finite());
        let across = rays.map(|r| r.roughness_m.abs() * r.cos_incidence / (1.0 + r.roughness_leverage).sqrt());
        statistics::median_upper(across.collect()).map_or(0.0, |m| f64::from(m) / statistics::MEDIAN_OF_NORMAL)
    };
    EDGE_M + NOISE_AT_EDGES * sides.map(usual).into_iter().fold(0.0, f64::max)
}

/// The frames of both sides as pairs, for the searches of returns and for those of shots. A pair holds the frames of
/// the same place in their order; nothing compares them return by return.
pub(super) fn as_pairs(ids: &[String], sides: [Vec<FrameAlone>; 2]) -> (Vec<FramePair>, Vec<FramePair>) {
    let [mut measured, simulated] = sides;
    show_ego_vehicle(&mut measured, &simulated);
    let pair = |id: &String, measured: Vec<Ray>, simulated: Vec<Ray>, edges: [RowEdges; 2]| FramePair {
        only_measured: alone(&measured),
        id: id.clone(),
        measured,
        simulated,
        edges,
        open: 0.0,
        second: [0.0; 2],
        objects: Vec::new(),
    };
    let both = ids.iter().zip(measured.into_iter().zip(simulated));
    both.map(|(id, (a, b))| {
        let edges = [a.edges, b.edges];
        // What of the shots has a return takes the place of what is matched: on the measured side what is lost, on the
        // simulated side what is lost anyway.
        (pair(id, a.returns, b.returns, edges), pair(id, b.shots, a.shots, edges))
    })
    .unzip()
}

/// Share of the frames in which a direction shows near returns from which on it always does.
const ALWAYS: f64 = 0.1;

/// Largest median deviation of the ranges of the ego vehicle in a direction, m: it moves with the sensor, and cars that
/// are passed by do not.
const STILL_M: f64 = 0.1;

/// Near measured returns in directions where the simulated side has none, always at one range, are of the ego vehicle:
/// they lie in front of all that the scene may have there.
fn show_ego_vehicle(measured: &mut [FrameAlone], simulated: &[FrameAlone]) {
    let near = |r: &&Ray| r.own_range_m() < OWN_CAR_M;
    let cells = |frame: &FrameAlone| -> BTreeSet<DirectionCell> {
        frame.returns.iter().filter(near).map(direction_cell).collect()
    };
    let mut frames_with = BTreeMap::<DirectionCell, f64>::new();
    for cell in simulated.iter().flat_map(cells) {
        *frames_with.entry(cell).or_default() += 1.0;
    }
    let always = |cell: &DirectionCell| {
        let around = neighbours(*cell).filter_map(|c| frames_with.get(&c));
        around.fold(0.0, |most: f64, n| most.max(*n)) >= ALWAYS * simulated.len() as f64
    };
    let mut ranges = BTreeMap::<DirectionCell, Vec<f64>>::new();
    for ray in measured.iter().flat_map(|f| &f.returns).filter(near) {
        ranges.entry(direction_cell(ray)).or_default().push(ray.own_range_m());
    }
    ranges.retain(|cell, ranges| !always(cell) && deviation_m(ranges) < STILL_M);
    for ray in measured.iter_mut().flat_map(|f| &mut f.returns) {
        if near(&&*ray) && ranges.contains_key(&direction_cell(ray)) {
            *ray = Ray { surface: Surface::Open, smooth: false, matched: false, near_far_m: [0.0; 2], ..*ray };
        }
    }
}

/// Median deviation of values from their median.
fn deviation_m(values: &[f64]) -> f64 {
    let middle = statistics::median_upper(values.to_vec()).unwrap_or(0.0);
    statistics::median_upper(values.iter().map(|v| (v - middle).abs()).collect::<Vec<f64>>()).unwrap_or(0.0)
}
