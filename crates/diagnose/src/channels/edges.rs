//! How ragged edges are. A beam that goes elsewhere from shot to shot meets now this side of an edge and now the
//! other: the edge of a post is then no line in the range image. Noise of ranges leaves it one, however it depends on
//! the angle of incidence.
//!
//! In each row an edge lies somewhere between two shots. Of a straight edge there is a line that goes between the
//! shots of all rows. Where there is none, a shot is on the wrong side. Each side is looked at by itself: where the
//! edge lies, and whether the scene is displaced, does not matter.

use crate::pairing::Ray;
use data::Stream;
use rand::RngExt;
use std::collections::BTreeMap;

/// Smallest range jump of an edge, m.
const JUMP_M: f64 = 1.5;

/// Largest difference of the two ranges on either side of an edge, as a share of the jump.
const LEVEL: f64 = 0.3;

/// Gaps of neighbouring shots, in steps.
const STEPS: std::ops::Range<f64> = 0.5..1.5;

/// Largest distance of an edge from that of the row below or above, in steps.
const UPRIGHT: f64 = 1.6;

/// Largest difference of the nearer ranges of an edge from row to row, m and as a share of the range.
const SAME_M: [f64; 2] = [0.5, 0.05];

/// Rows below and above that an edge is followed to.
const REACH: u16 = 4;

/// Fewest rows of an edge that tell whether it is a line.
const LEAST_ROWS: usize = 5;

/// Slopes of lines that are tried, in steps from one row to the next: their number either way, and their distance.
const SLOPES: (i32, f64) = (32, 0.05);

/// A line needs so much room between the shots, in steps: shots of several rows may aim at one azimuth.
const ROOM: f64 = 0.05;

/// Random draws of each edge by which it is found how ragged jitter makes it.
const DRAWS: usize = 4;

/// Edges over several rows.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Edges {
    /// Their number.
    pub all: f64,
    /// Those that are no line.
    pub ragged: f64,
    /// How many more would be ragged if the directions scattered with the standard deviation that was asked for.
    pub by_jitter: f64,
}

/// An edge in a row.
#[derive(Clone, Copy)]
struct Edge {
    /// Azimuths of the shots on either side of it, rad, ascending.
    between_rad: [f64; 2],
    /// The nearer range, m.
    near_m: f64,
    /// Whether the surface at the smaller azimuth is the nearer one.
    rises: bool,
}

impl Edge {
    fn middle_rad(&self) -> f64 {
        (self.between_rad[0] + self.between_rad[1]) / 2.0
    }

    /// The shots on either side, in steps.
    fn between(&self, step: f64) -> [f64; 2] {
        self.between_rad.map(|azimuth| azimuth / step)
    }
}

/// A line through an edge: its slope, and the azimuths that it may have in the middle row, in steps.
type Line = (f64, [f64; 2]);

/// The shots about an edge: rows from the middle one, and the azimuths on either side, in steps.
type Shots = Vec<(f64, [f64; 2])>;

/// Lines that go between the shots of all rows.
fn lines(shots: &Shots) -> Vec<Line> {
    let (number, distance) = SLOPES;
    let line = |k: i32| {
        let slope = f64::from(k) * distance;
        let of = |(row, [before, after]): &(f64, [f64; 2])| [before - slope * row, after - slope * row];
        let room = shots.iter().map(of).fold([f64::MIN, f64::MAX], |[a, b], [c, d]| [a.max(c), b.min(d)]);
        (slope, room)
    };
    (-number..=number).map(line).filter(|(_, [from, to])| to - from > ROOM).collect()
}

/// Whether a straight edge is no line once the directions of its shots scatter, by random draws: their share.
fn by_jitter(shots: &Shots, lines: &[Line], std: f64, rng: &mut Stream) -> f64 {
    let room: f64 = lines.iter().map(|(_, [from, to])| to - from).sum();
    let mut drawn = || {
        let mut place = rng.random::<f64>() * room;
        let line = lines.iter().find(|(_, [from, to])| {
            place -= to - from;
            place <= 0.0
        });
        let (slope, [_, to]) = line.or(lines.last()).copied().unwrap_or((0.0, [0.0; 2]));
        let seen = |(row, [before, after]): &(f64, [f64; 2])| {
            let at = to + place.min(0.0) + slope * row;
            let mut passes = |away: f64| rng.random::<f64>() < beyond(away / std.max(1e-9));
            let between = match [passes(at - before), passes(after - at)] {
                [false, true] => [*after, after + 1.0],
                [true, false] => [before - 1.0, *before],
                _ => [*before, *after],
            };
            (*row, between)
        };
        self::lines(&shots.iter().map(seen).collect()).is_empty()
    };
    (0..DRAWS).filter(|_| drawn()).count() as f64 / DRAWS as f64
}

/// Returns by sensor and row, as azimuth (rad) and range (m), in the order of the azimuth.
fn rows(rays: &[Ray]) -> BTreeMap<(u8, u16), Vec<[f64; 2]>> {
    let mut rows = BTreeMap::<(u8, u16), Vec<[f64; 2]>>::new();
    for ray in rays.iter().filter(|r| r.row != u16::MAX) {
        rows.entry((ray.sensor, ray.row)).or_default().push([f64::from(ray.azimuth_rad), ray.own_range_m()]);
    }
    rows.values_mut().for_each(|row| row.sort_by(|a, b| a[0].total_cmp(&b[0])));
    rows
}

/// Usual distance of neighbouring shots of a row by sensor, rad; none of a sensor without rows.
pub fn steps_rad(rays: &[Ray], sensors: usize) -> Vec<Option<f64>> {
    let rows = rows(rays);
    let of_sensor = |sensor: usize| {
        let own = rows.iter().filter(|((of, _), _)| usize::from(*of) == sensor);
        statistics::median_upper(own.flat_map(|(_, row)| row.windows(2).map(|w| w[1][0] - w[0][0])).collect())
    };
    (0..sensors).map(of_sensor).collect()
}

/// The edges of one side of a frame, and how ragged directions with a standard deviation (rad) would make them, where
/// that is asked for.
pub fn edges(rays: &[Ray], steps_rad: &[Option<f64>], std_rad: Option<f64>) -> Edges {
    let step_of = |sensor: u8| steps_rad.get(usize::from(sensor)).copied().flatten();
    let of_row = |((sensor, row), shots): ((u8, u16), Vec<[f64; 2]>)| {
        let step = step_of(sensor)?;
        Some(((sensor, row), shots.windows(4).filter_map(|four| edge(four, step)).collect()))
    };
    let rows: BTreeMap<(u8, u16), Vec<Edge>> = rows(rays).into_iter().filter_map(of_row).collect();
    let mut out = Edges::default();
    let mut rng = data::stream(0, "diagnose edges", rays.len() as u64, 0);
    for (&(sensor, row), own) in &rows {
        let Some(step) = step_of(sensor) else { continue };
        for edge in own {
            let mut shots: Shots = vec![(0.0, edge.between(step))];
            for way in [-1i32, 1] {
                let mut last = edge;
                for k in 1..=i32::from(REACH) {
                    let other = u16::try_from(i32::from(row) + way * k).ok().and_then(|row| rows.get(&(sensor, row)));
                    let Some(next) = other.and_then(|others| goes_on(last, others, step)) else { break };
                    shots.push((f64::from(way * k), next.between(step)));
                    last = next;
                }
            }
            if shots.len() < LEAST_ROWS {
                continue;
            }
            let lines = lines(&shots);
            out.all += 1.0;
            if lines.is_empty() {
                out.ragged += 1.0;
            } else if let Some(std_rad) = std_rad {
                out.by_jitter += by_jitter(&shots, &lines, std_rad / step, &mut rng);
            }
        }
    }
    out
}

/// The edge between the second and the third of four shots.
fn edge(shots: &[[f64; 2]], step: f64) -> Option<Edge> {
    let ranges: [f64; 4] = std::array::from_fn(|k| shots[k][1]);
    let jump = (ranges[2] - ranges[1]).abs();
    let level = |a: f64, b: f64| (a - b).abs() < LEVEL * jump;
    let beside = shots.windows(2).all(|w| STEPS.contains(&((w[1][0] - w[0][0]) / step)));
    let is_edge = jump > JUMP_M && beside && level(ranges[0], ranges[1]) && level(ranges[2], ranges[3]);
    is_edge.then(|| Edge {
        between_rad: [shots[1][0], shots[2][0]],
        near_m: ranges[1].min(ranges[2]),
        rises: ranges[1] < ranges[2],
    })
}

/// The same edge in another row.
fn goes_on<'a>(edge: &Edge, others: &'a [Edge], step: f64) -> Option<&'a Edge> {
    let off = |other: &Edge| (other.middle_rad() - edge.middle_rad()).abs();
    let same = |other: &&Edge| {
        let near_m = (other.near_m - edge.near_m).abs() < SAME_M[0] + SAME_M[1] * edge.near_m;
        other.rises == edge.rises && near_m && off(other) <= UPRIGHT * step
    };
    others.iter().filter(same).min_by(|a, b| off(a).total_cmp(&off(b)))
}

/// Probability that a standard normal variable is above `z`.
fn beyond(z: f64) -> f64 {
    0.5 * libm::erfc(z / std::f64::consts::SQRT_2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use rand_distr::{Distribution, Normal};

    const STEP: f64 = 0.01;

    /// Posts, each with a slant of its own, at 10 m before a wall at 20 m, seen by 32 rows whose directions scatter.
    /// Each row begins elsewhere by a part of a step.
    fn posts(std_rad: f64, stagger: f64) -> Vec<Ray> {
        let mut rng = data::stream(1, "edges test", 0, 0);
        let jitter = Normal::new(0.0, std_rad).unwrap();
        let widths: Vec<f64> = (0..60).map(|_| rng.random_range(3.2..6.8)).collect();
        let slants: Vec<f64> = (0..60).map(|_| rng.random_range(-0.06..0.06)).collect();
        let begins: Vec<f64> = (0..32).map(|_| stagger * rng.random_range(-0.5..0.5)).collect();
        let mut rays = vec![];
        for (row, column) in (0..32u16).flat_map(|row| (0..600u16).map(move |column| (row, column))) {
            let azimuth = (f64::from(column) + begins[usize::from(row)] + 1.0) * STEP;
            let within = (azimuth + jitter.sample(&mut rng)) / STEP;
            let post = (within / 10.0).clamp(0.0, 59.0) as usize;
            let from = 10.0 * post as f64 + 2.0 + slants[post] * (f64::from(row) - 16.0);
            let on_post = (from..from + widths[post]).contains(&within);
            let range = if on_post { 10.0 } else { 20.0 };
            let elevation = f64::from(row) * 0.01;
            let (sin, cos) = azimuth.sin_cos();
            let at = Vector3::new(cos * elevation.cos(), sin * elevation.cos(), elevation.sin()) * range;
            rays.push(Ray { row, azimuth_rad: azimuth as f32, ..Ray::standing(&at) });
        }
        rays
    }

    #[test]
    fn jitter_makes_edges_ragged() {
        for stagger in [0.0, 1.0] {
            let still = posts(0.0, stagger);
            let steps = steps_rad(&still, 1);
            assert!((steps[0].unwrap() / STEP - 1.0).abs() < 1e-3);
            for std in [0.05, 0.1, 0.2] {
                let straight = edges(&still, &steps, Some(std * STEP));
                // Of shots that lie between each other some leave no room for a line.
                assert!(straight.all > 2000.0 && straight.ragged < 0.1 * straight.all, "{straight:?}");
                let found = edges(&posts(std * STEP, stagger), &steps, None);
                let more = found.ragged / found.all - straight.ragged / straight.all;
                // What is stated is of edges of any slant: upright ones are ragged up to three times as often.
                let stated = straight.by_jitter / straight.all;
                assert!(more > 0.3 * stated, "{stagger} {std}: {more} for {stated}");
            }
        }
    }
}
