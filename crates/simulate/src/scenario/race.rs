//! Generated race: an ego vehicle and rivals on the oval. Relative positions follow figure 4 of Huch et al. 2023:
//! rivals are mostly about 35 m ahead on the left and 30 m behind on the right, some farther away, and some passing.

use super::trajectory::{CarState, Trajectory};
use super::{FRAME_S, Run};
use crate::track::Track;
use data::KeyError;
use data::toml_text::{within, wrong};
use data::{Stream, stream};
use geometry::Pose;
use rand::RngExt;
use schemars::JsonSchema;
use sensor::car::ORIGIN_ABOVE_GROUND_M;
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// A generated race with a random seed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RaceModel {
    /// Number of runs, with different starting positions.
    pub runs: u32,
    /// Total number of frames of all runs, at 20 Hz. 32,951 as in the paper are about 27 minutes.
    pub frames: usize,
    /// Number of rivals, 1 to 3. The first is mostly behind, the last mostly ahead.
    pub rivals: usize,
    /// Minimum and maximum speed of the ego vehicle, m/s.
    pub speed_mps: [f64; 2],
}

impl Default for RaceModel {
    fn default() -> Self {
        RaceModel { runs: 3, frames: 32_951, rivals: 3, speed_mps: [25.0, 70.0] }
    }
}

/// Preferred positions of each rival relative to the ego vehicle (m ahead along the track) and their weights.
const PLACES: [&[(f64, f64)]; 3] = [
    &[(-30.0, 0.60), (-45.0, 0.15), (-70.0, 0.15), (-92.0, 0.10)],
    &[(-30.0, 0.30), (35.0, 0.40), (50.0, 0.15), (8.0, 0.05), (-10.0, 0.10)],
    &[(35.0, 0.55), (55.0, 0.20), (75.0, 0.15), (94.0, 0.10)],
];
/// Time that a rival stays at a position, s.
const STAY_S: [f64; 2] = [8.0, 25.0];
/// Speed relative to the ego vehicle while changing position, m/s.
const CLOSING_MPS: f64 = 5.0;
/// Lateral offset from the ego vehicle, m: to the left when ahead, to the right when behind or passing.
const ASIDE_M: f64 = 5.0;
/// A rival moves to the left between these distances ahead, m.
const MOVES_OVER_M: [f64; 2] = [13.0, 24.0];
/// Minimum distance between rivals along the track, m.
const SPACING_M: f64 = 13.0;
/// Minimum distance of a car's centre from the track edges, m.
const MARGIN_M: f64 = 1.25;

impl RaceModel {
    pub(crate) fn check(&self) -> Result<(), KeyError> {
        within("runs", self.runs.into(), 1.0, 100.0)?;
        within("rivals", self.rivals as f64, 0.0, PLACES.len() as f64)?;
        let [low, high] = self.speed_mps;
        within("speed_mps[1]", high, 1.0, 110.0)?;
        within("speed_mps[0]", low, 0.5, high)?;
        if self.frames < self.runs as usize * 40 || self.frames > 10_000_000 {
            return Err(wrong("frames", format!("{} are not between 40 a run and 10 million", self.frames)));
        }
        Ok(())
    }

    /// Generates the runs; their lengths differ by at most one frame and add up to `frames`.
    pub fn runs(&self, track: &Track, seed: u64) -> Vec<Run> {
        let runs = self.runs as usize;
        (0..runs)
            .map(|run| {
                let frames = self.frames * (run + 1) / runs - self.frames * run / runs;
                self.run(track, frames, &mut |purpose: &str| stream(seed, &format!("race/{purpose}"), run as u64, 0))
            })
            .collect()
    }

    fn run(&self, track: &Track, frames: usize, random: &mut dyn FnMut(&str) -> Stream) -> Run {
        // One more state at both ends, so that the first and last frame have a complete scan and GPS records before
        // and after.
        let states = frames + 8;
        let time = |i: usize| (i as f64 - 4.0) * FRAME_S;
        let mut ego_random = random("ego");
        let speed = Stages::speeds(self.speed_mps, time(states), &mut ego_random);
        let ego_aside = Waves::make(&mut ego_random, 1.1, 18.0);
        let mut way = ego_random.random_range(0.0..track.line.length_m());
        let rivals: Vec<Rival> =
            (0..self.rivals).map(|k| Rival::make(k, time(states), &mut random(&format!("rival {k}")))).collect();

        let mut poses: Vec<Vec<Pose>> = vec![Vec::with_capacity(states); self.rivals + 1];
        for i in 0..states {
            let t = time(i);
            let aside = ego_aside.at(t) + 0.3;
            poses[0].push(place(track, way, aside));
            let mut behind = f64::NEG_INFINITY;
            for (k, rival) in rivals.iter().enumerate() {
                let wanted = rival.ahead_m.at(t) + rival.wobble.at(t);
                behind = if behind.is_finite() {
                    behind + SPACING_M + soft_positive(wanted - behind - SPACING_M)
                } else {
                    wanted
                };
                let over = ((behind - MOVES_OVER_M[0]) / (MOVES_OVER_M[1] - MOVES_OVER_M[0])).clamp(0.0, 1.0);
                let side = 2.0 * over * over * (3.0 - 2.0 * over) - 1.0;
                poses[k + 1].push(place(track, way + behind, aside + side * ASIDE_M + rival.aside.at(t)));
            }
            way += FRAME_S * speed.at(t);
        }
        let mut cars = poses.into_iter().map(|poses| trajectory(&poses, time));
        let ego = cars.next().expect("there is an ego car");
        Run { ego, rivals: cars.collect(), first_s: 0.0, frames, step_s: FRAME_S }
    }
}

/// Pose of a car at a track position, heading along the track; kept off the edges.
fn place(track: &Track, way_m: f64, left_m: f64) -> Pose {
    let [low, high] = track.lateral_limits_m(way_m, MARGIN_M);
    track.pose_on(way_m, left_m.clamp(low, high), 0.0, ORIGIN_ABOVE_GROUND_M)
}

/// States from equidistant poses, with velocities by central differences; the first and last pose are dropped.
fn trajectory(poses: &[Pose], time: impl Fn(usize) -> f64) -> Trajectory {
    let state = |i: usize| {
        let velocity = (poses[i + 1].translation.vector - poses[i - 1].translation.vector) / (2.0 * FRAME_S);
        CarState::of(time(i), &poses[i], velocity)
    };
    Trajectory::from_states((1..poses.len() - 1).map(state).collect())
}

/// A smooth approximation of `max(v, 0)`, m.
fn soft_positive(v: f64) -> f64 {
    const SCALE_M: f64 = 3.0;
    let x = v / SCALE_M;
    SCALE_M * (x.max(0.0) + (-x.abs()).exp().ln_1p())
}

/// A rival.
struct Rival {
    ahead_m: Stages,
    wobble: Waves,
    aside: Waves,
}

impl Rival {
    fn make(k: usize, until_s: f64, random: &mut Stream) -> Rival {
        let places = PLACES[k];
        let pick = |random: &mut Stream| {
            let mut left = random.random_range(0.0..places.iter().map(|p| p.1).sum::<f64>());
            let found = places.iter().find(|(_, share)| {
                left -= share;
                left < 0.0
            });
            found.unwrap_or(&places[0]).0
        };
        let mut stages = Stages { values: vec![(-10.0, -5.0, pick(random))] };
        while stages.end_s() < until_s {
            let (start, next) = (stages.end_s() + random.random_range(STAY_S[0]..STAY_S[1]), pick(random));
            // The peak rate of a smooth step is 1.5 times that of a linear one.
            let change_s = (1.5 * (next - stages.last()).abs() / CLOSING_MPS).max(2.0);
            stages.values.push((start, start + change_s, next));
        }
        Rival { ahead_m: stages, wobble: Waves::make(random, 4.0, 23.0), aside: Waves::make(random, 0.7, 11.0) }
    }
}

/// A value with smooth changes between constant stages: (start of a change, its end, value afterwards), s.
struct Stages {
    values: Vec<(f64, f64, f64)>,
}

impl Stages {
    /// Speeds between two limits; mostly near the upper one, as in a race with slow laps in between.
    fn speeds([low, high]: [f64; 2], until_s: f64, random: &mut Stream) -> Stages {
        let pick = |random: &mut Stream| high - (high - low) * random.random_range(0.0_f64..1.0).powf(1.7);
        let mut stages = Stages { values: vec![(-10.0, -5.0, pick(random))] };
        while stages.end_s() < until_s {
            let (start, next) = (stages.end_s() + random.random_range(8.0..30.0), pick(random));
            let change_s = (1.5 * (next - stages.last()).abs() / 3.5).max(2.0); // at most 3.5 m/s2
            stages.values.push((start, start + change_s, next));
        }
        stages
    }

    fn end_s(&self) -> f64 {
        self.values[self.values.len() - 1].1
    }

    fn last(&self) -> f64 {
        self.values[self.values.len() - 1].2
    }

    fn at(&self, time_s: f64) -> f64 {
        let next = self.values.partition_point(|v| v.0 <= time_s).max(1);
        let (begin, end, value) = self.values[next - 1];
        let before = if next >= 2 { self.values[next - 2].2 } else { value };
        let t = ((time_s - begin) / (end - begin)).clamp(0.0, 1.0);
        before + (value - before) * t * t * (3.0 - 2.0 * t)
    }
}

/// A sum of three slow sine waves.
struct Waves([(f64, f64, f64); 3]);

impl Waves {
    /// Waves with about this standard deviation, and periods around `period_s`.
    fn make(random: &mut Stream, deviation: f64, period_s: f64) -> Waves {
        Waves([0.7, 1.0, 1.9].map(|stretch| {
            let rate = TAU / (period_s * stretch * random.random_range(0.8..1.25));
            (deviation * (2.0_f64 / 3.0).sqrt(), rate, random.random_range(0.0..TAU))
        }))
    }

    fn at(&self, time_s: f64) -> f64 {
        self.0.iter().map(|(size, rate, phase)| size * (rate * time_s + phase).sin()).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::track::las_vegas;
    use geometry::{bev_intersection, move_box};
    use sensor::car::car_box;

    fn track() -> Track {
        Track { line: las_vegas(), seed: 1 }
    }

    /// Boxes of the rivals in the ego frame, every half second.
    fn relative(runs: &[Run]) -> Vec<Vec<geometry::Box3>> {
        let mut all = Vec::new();
        for run in runs {
            for i in (0..run.frames).step_by(10) {
                let t = run.time_s(i);
                let ego = run.ego.at(t).unwrap().pose;
                let boxes = run.rivals.iter().map(|r| move_box(&(ego.inverse() * r.at(t).unwrap().pose), &car_box()));
                all.push(boxes.collect());
            }
        }
        all
    }

    #[test]
    fn rivals_are_where_the_paper_sees_them() {
        let model = RaceModel { frames: 12_000, ..RaceModel::default() };
        let frames = relative(&model.runs(&track(), 7));
        let all: Vec<[f64; 3]> = frames.iter().flatten().map(|b| b.center).collect();
        let share = |x: [f64; 2], y: [f64; 2]| {
            let inside = |c: &&[f64; 3]| (x[0]..x[1]).contains(&c[0]) && (y[0]..y[1]).contains(&c[1]);
            all.iter().filter(inside).count() as f64 / all.len() as f64
        };
        let (ahead_left, behind_right) = (share([22.0, 50.0], [1.0, 12.0]), share([-48.0, -18.0], [-9.0, 1.0]));
        assert!(ahead_left > 0.15 && behind_right > 0.15, "{ahead_left} {behind_right}");
        assert!(share([22.0, 50.0], [-12.0, -3.0]) < 0.05, "few ahead to the right");
        let far = all.iter().filter(|c| c[0].hypot(c[1]) > 66.6).count() as f64 / all.len() as f64;
        assert!((0.05..0.35).contains(&far), "{far}");
    }

    #[test]
    fn nobody_collides_or_leaves_the_track() {
        let track = track();
        let model = RaceModel { frames: 9_000, ..RaceModel::default() };
        let runs = model.runs(&track, 3);
        let ego = car_box();
        for boxes in relative(&runs) {
            for (i, b) in boxes.iter().enumerate() {
                assert_eq!(bev_intersection(b, &ego), 0.0, "{b:?}");
                assert!(boxes[..i].iter().all(|other| bev_intersection(b, other) == 0.0));
            }
        }
        let mut fastest: f64 = 0.0;
        for run in &runs {
            for car in std::iter::once(&run.ego).chain(&run.rivals) {
                for state in car.states().iter().step_by(7) {
                    let (way, left) = track.line.project([state.x_m, state.y_m]);
                    let [low, high] = track.lateral_limits_m(way, 1.0);
                    assert!((low..=high).contains(&left), "{left} m at {way}");
                    fastest = fastest.max(state.velocity().norm());
                }
            }
        }
        assert!((60.0..82.0).contains(&fastest), "{fastest} m/s");
    }

    #[test]
    fn the_seed_makes_the_race() {
        let (track, model) = (track(), RaceModel { frames: 301, ..RaceModel::default() });
        let runs = model.runs(&track, 1);
        assert_eq!(runs.iter().map(|r| r.frames).collect::<Vec<_>>(), [100, 100, 101]);
        assert_eq!(runs, model.runs(&track, 1));
        assert_ne!(runs, model.runs(&track, 2));
        // Generated runs pass the checks of runs from files.
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rival.csv");
        std::fs::write(&path, runs[0].rivals[0].to_csv()).unwrap();
        assert_eq!(Trajectory::read(&path).unwrap(), runs[0].rivals[0]);
    }
}
