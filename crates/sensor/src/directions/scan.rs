//! The points of one sensor by direction, and an index to find the neighbours of a direction.

use crate::assignment::{Assigned, Assignment};
use crate::rig::{Rig, Sensor};
use data::Cloud;
use nalgebra::Point3;
use std::f64::consts::TAU;

/// The returns of one sensor in one frame, in its own frame.
#[derive(Clone, Debug, Default)]
pub struct SensorScan {
    /// Counter-clockwise from its middle, rad.
    pub azimuth_rad: Vec<f32>,
    /// Up from its horizon, rad.
    pub elevation_rad: Vec<f32>,
    /// Distance, m.
    pub range_m: Vec<f32>,
    /// Intensity in the unit of the cloud; empty for clouds without the column.
    pub intensity: Vec<f32>,
}

impl SensorScan {
    /// Number of returns.
    pub fn len(&self) -> usize {
        self.range_m.len()
    }

    /// Place of a return in the sensor's frame, m.
    pub fn point(&self, i: usize) -> Point3<f64> {
        let [az, el, range] = [self.azimuth_rad[i], self.elevation_rad[i], self.range_m[i]].map(f64::from);
        Point3::new(range * el.cos() * az.cos(), range * el.cos() * az.sin(), range * el.sin())
    }

    /// Moves every return, in the sensor's frame.
    pub fn move_points(&mut self, moved: impl Fn(&Point3<f64>) -> Point3<f64>) {
        for i in 0..self.len() {
            let [az, el, range] = Sensor::spherical(&moved(&self.point(i))).map(|v| v as f32);
            (self.azimuth_rad[i], self.elevation_rad[i], self.range_m[i]) = (az, el, range.max(NEAREST_M as f32));
        }
    }

    /// No return.
    pub fn is_empty(&self) -> bool {
        self.range_m.is_empty()
    }
}

/// Smallest range of a point with a direction, m.
const NEAREST_M: f64 = 0.05;

/// Gives each point of an unordered cloud to a sensor, as [`Assignment`] says. Two clouds of the same scene are split
/// alike.
pub fn split_by_sensor(cloud: &Cloud, rig: &Rig) -> Vec<SensorScan> {
    split(cloud, rig, |_, _| ())
}

/// The same, with the numbers of each sensor's points in the cloud.
pub fn split_with_places(cloud: &Cloud, rig: &Rig) -> (Vec<SensorScan>, Vec<Vec<u32>>) {
    let mut places = vec![Vec::new(); rig.sensors.len()];
    let scans = split(cloud, rig, |sensor, point| places[sensor].push(point as u32));
    (scans, places)
}

fn split(cloud: &Cloud, rig: &Rig, mut given: impl FnMut(usize, usize)) -> Vec<SensorScan> {
    let assignment = Assignment::new(rig);
    let mut scans = vec![SensorScan::default(); rig.sensors.len()];
    for (number, point) in cloud.points().enumerate() {
        let p = Point3::new(f64::from(point[0]), f64::from(point[1]), f64::from(point[2]));
        if let Some(Assigned { sensor, spherical: [az, el, range] }) = assignment.of_point(p)
            && range > NEAREST_M
        {
            scans[sensor].azimuth_rad.push(az as f32);
            scans[sensor].elevation_rad.push(el as f32);
            scans[sensor].range_m.push(range as f32);
            scans[sensor].intensity.extend(point.get(3));
            given(sensor, number);
        }
    }
    scans
}

/// Angle between neighbouring shots of a sensor, rad.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Steps {
    /// Along a row.
    pub azimuth_rad: f32,
    /// From row to row.
    pub elevation_rad: f32,
}

/// Finds the returns around a direction: cells of the size of the window, sorted.
pub struct DirectionIndex {
    window: Steps,
    low: [f32; 2],
    cells: [usize; 2],
    starts: Vec<u32>,
    entries: Vec<Entry>,
}

/// Entries that are tested for the window at once.
const CHUNK: usize = 64;

/// A return in the index.
#[derive(Clone, Copy, Debug)]
pub struct Entry {
    /// Azimuth, rad; beyond half a turn for copies of returns on the other side of the seam.
    pub azimuth_rad: f32,
    /// Elevation, rad.
    pub elevation_rad: f32,
    /// Distance, m.
    pub range_m: f32,
    /// Its place in the scan.
    pub index: u32,
}

/// A return within the window around a direction.
#[derive(Clone, Copy, Debug)]
pub struct Neighbour {
    /// The return.
    pub entry: Entry,
    /// Its offset from the direction in azimuth and elevation, in windows (-1..=1).
    pub offset: [f32; 2],
}

impl DirectionIndex {
    /// An index for windows of `steps` to each side.
    pub fn new(scan: &SensorScan, window: Steps, closes: bool) -> Self {
        let mut entries: Vec<Entry> = (0..scan.len())
            .map(|i| Entry {
                azimuth_rad: scan.azimuth_rad[i],
                elevation_rad: scan.elevation_rad[i],
                range_m: scan.range_m[i],
                index: i as u32,
            })
            .collect();
        if closes {
            let turn = TAU as f32;
            let margin = std::f32::consts::PI - 2.0 * window.azimuth_rad;
            let copies: Vec<Entry> = entries
                .iter()
                .filter(|e| e.azimuth_rad.abs() > margin)
                .map(|e| Entry { azimuth_rad: e.azimuth_rad - turn.copysign(e.azimuth_rad), ..*e })
                .collect();
            entries.extend(copies);
        }
        let bound = |f: fn(&Entry) -> f32| {
            entries.iter().map(f).fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)))
        };
        let (az, el) = (bound(|e| e.azimuth_rad), bound(|e| e.elevation_rad));
        let count = |(low, high): (f32, f32), step: f32| {
            if high >= low { ((((high - low) / step) as usize) + 1).min(20_000) } else { 1 }
        };
        let cells = [count(az, window.azimuth_rad), count(el, window.elevation_rad)];
        let mut index = DirectionIndex { window, low: [az.0, el.0], cells, starts: Vec::new(), entries: Vec::new() };
        let mut counts = vec![0u32; cells[0] * cells[1] + 1];
        let of: Vec<usize> = entries.iter().map(|e| index.cell(e.azimuth_rad, e.elevation_rad)).collect();
        for c in &of {
            counts[c + 1] += 1;
        }
        for i in 1..counts.len() {
            counts[i] += counts[i - 1];
        }
        let mut next = counts.clone();
        let mut sorted = entries.clone();
        for (e, c) in entries.iter().zip(of) {
            sorted[next[c] as usize] = *e;
            next[c] += 1;
        }
        (index.starts, index.entries) = (counts, sorted);
        index
    }

    fn axis(&self, k: usize, v: f32) -> i64 {
        let step = if k == 0 { self.window.azimuth_rad } else { self.window.elevation_rad };
        let at = (v - self.low[k]) / step;
        // `floor` is a call where the processor may lack the instruction.
        let whole = at as i64;
        if whole as f32 > at { whole - 1 } else { whole }
    }

    fn cell(&self, az: f32, el: f32) -> usize {
        let [x, y] = [self.axis(0, az), self.axis(1, el)];
        let x = x.clamp(0, self.cells[0] as i64 - 1) as usize;
        let y = y.clamp(0, self.cells[1] as i64 - 1) as usize;
        y * self.cells[0] + x
    }

    /// Puts the returns within the window around a direction into a list, in place of what it holds.
    pub fn neighbours(&self, az: f32, el: f32, into: &mut Vec<Neighbour>) {
        into.clear();
        self.around(az, el, |entry, dx, dy| into.push(Neighbour { entry: *entry, offset: [dx, dy] }));
    }

    /// Calls `visit` with every return within the window around a direction, and its offsets in windows (-1..=1).
    pub fn around(&self, az: f32, el: f32, mut visit: impl FnMut(&Entry, f32, f32)) {
        if self.entries.is_empty() {
            return;
        }
        let [x, y] = [self.axis(0, az), self.axis(1, el)];
        let clamp = |v: i64, n: usize| v.clamp(0, n as i64 - 1) as usize;
        if x < -1 || y < -1 || x > self.cells[0] as i64 || y > self.cells[1] as i64 {
            return;
        }
        let (x0, x1) = (clamp(x - 1, self.cells[0]), clamp(x + 1, self.cells[0]));
        for row in clamp(y - 1, self.cells[1])..=clamp(y + 1, self.cells[1]) {
            let at = row * self.cells[0];
            let range = self.starts[at + x0] as usize..self.starts[at + x1 + 1] as usize;
            for cells in self.entries[range].chunks(CHUNK) {
                // Without a branch for each entry: less than half of them are in the window, in no order that a
                // processor could predict. The quotients of a visit are at most 1 exactly where the differences are at
                // most the window.
                let (mut inside, mut n) = ([0u8; CHUNK], 0);
                for (k, entry) in cells.iter().enumerate() {
                    inside[n] = k as u8;
                    let near_az = (entry.azimuth_rad - az).abs() <= self.window.azimuth_rad;
                    let near_el = (entry.elevation_rad - el).abs() <= self.window.elevation_rad;
                    n += usize::from(near_az & near_el);
                }
                for &k in &inside[..n] {
                    let entry = &cells[usize::from(k)];
                    let dx = (entry.azimuth_rad - az) / self.window.azimuth_rad;
                    let dy = (entry.elevation_rad - el) / self.window.elevation_rad;
                    visit(entry, dx, dy);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn finds_what_a_search_of_all_finds(
            points in prop::collection::vec((-3.1f32..3.1, -0.4f32..0.2), 0..300),
            az in -3.1f32..3.1, el in -0.4f32..0.2,
        ) {
            let scan = SensorScan {
                azimuth_rad: points.iter().map(|p| p.0).collect(),
                elevation_rad: points.iter().map(|p| p.1).collect(),
                range_m: vec![1.0; points.len()],
                intensity: vec![],
            };
            let window = Steps { azimuth_rad: 0.15, elevation_rad: 0.05 };
            let index = DirectionIndex::new(&scan, window, true);
            let mut found = Vec::new();
            index.around(az, el, |e, _, _| found.push(e.index));
            found.sort_unstable();
            let want: Vec<u32> = (0..points.len() as u32).filter(|&i| {
                let (a, e) = points[i as usize];
                let d = [a - az, a - az - TAU as f32, a - az + TAU as f32].into_iter().fold(f32::MAX, |m, v| m.min(v.abs()));
                d <= window.azimuth_rad * 0.9999 && (e - el).abs() <= window.elevation_rad * 0.9999
            }).collect();
            for i in &want {
                prop_assert!(found.contains(i));
            }
            prop_assert!(found.len() <= want.len() + 2);
        }
    }

    #[test]
    fn points_go_to_the_sensor_that_sees_them() {
        let mut rig = Rig::single();
        rig.sensors[0].horizontal_fov_deg = 120.0;
        let mut left = rig.sensors[0].clone();
        left.yaw_deg = 120.0;
        rig.sensors.push(left);
        let cloud = Cloud { values: vec![10.0, 0.0, 0.0, -5.0, 5.0, 0.0, 0.0, 0.0, 0.01], channels: 3 };
        let scans = split_by_sensor(&cloud, &rig);
        assert_eq!((scans[0].len(), scans[1].len()), (1, 1));
        assert!((scans[1].azimuth_rad[0].to_degrees() - 15.0).abs() < 1e-4);
    }
}
