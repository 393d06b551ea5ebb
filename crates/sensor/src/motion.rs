//! Motion from frame to frame: of the ego vehicle, from posts, ends of walls and other static edges, and from the
//! ground; of labelled objects, from their labels.

mod followed;
mod ground;
mod matches;

pub use followed::{SeenVelocity, seen_velocity};
use geometry::Box3;
use ground::tilt;
pub use ground::{Ground, GroundPoint};
pub use matches::{CELL_M, Cells};
use matches::{OfThree, Turned};
use nalgebra::{Vector2, Vector3};
use rayon::prelude::*;
use statistics::median_upper;
use std::collections::BTreeSet;

/// Motion of the ego vehicle in its own frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OwnMotion {
    /// Velocity, m/s.
    pub velocity_m_s: Vector3<f64>,
    /// Rates of turn about the axes, rad/s.
    pub turn_rate_rad_s: Vector3<f64>,
}

impl OwnMotion {
    /// Straight ahead, m/s.
    pub fn ahead(speed_m_s: f64) -> Self {
        OwnMotion { velocity_m_s: Vector3::new(speed_m_s, 0.0, 0.0), turn_rate_rad_s: Vector3::zeros() }
    }

    /// Speed along the heading, m/s.
    pub fn speed_m_s(&self) -> f64 {
        self.velocity_m_s.x
    }

    /// Velocity over ground of a point that is fixed to the vehicle, m/s.
    pub fn velocity_at(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.velocity_m_s + self.turn_rate_rad_s.cross(point)
    }
}

/// What of a frame stands still.
#[derive(Clone, Debug)]
pub struct Standing {
    edges: Vec<Vector2<f64>>,
    ground: Vec<GroundPoint>,
}

impl Standing {
    /// From returns at edges of standing surfaces, place in the cloud's frame and range, m, of which those near
    /// labelled objects are left out; and from points of the ground, of which a part is kept.
    pub fn new(
        returns: impl IntoIterator<Item = (Vector3<f64>, f64)>,
        boxes: &[Box3],
        ground: Vec<GroundPoint>,
    ) -> Self {
        let some = some_of(&ground, ground::SOME);
        let ground = Ground::new(ground);
        let standing = returns.into_iter().filter(|(place, _)| ground.is_below(place));
        Standing { edges: static_edges(standing, boxes), ground: some }
    }
}

/// Number of speeds of the grid.
const SPEEDS: usize = 160;

/// Step of the grid of speeds, m/s.
const SPEED_M_S: f64 = 0.6;

/// Largest acceleration of a vehicle, m/s2.
const HARDEST_M_S2: f64 = 15.0;

/// Longest time between two frames that are compared, s.
const LONGEST_S: f64 = 1.05;

/// Largest rate of turn of a vehicle, rad/s: at a junction.
const SHARPEST_RAD_S: f64 = 0.9;

/// Fewest edges of a frame.
const FEWEST: usize = 40;

/// Shortest time between a frame and the reference frames that show matches by chance, s.
const ELSEWHERE_S: f64 = 0.5;

/// Frames among which the references of a pair are chosen, at most: more would make the time quadratic.
const REFERENCES: usize = 400;

/// Edges of a frame that are compared, at most.
const SOME: usize = 250;

/// Ratio of the score of the best path of speeds to that of the best path by chance from which on it is significant.
const STANDS_OUT: f64 = 1.25;

/// Index of the smallest speed of the search, 4.8 m/s: the scan pattern is static in the frame of the vehicle and
/// resembles standstill.
const SLOWEST: usize = 8;

/// Motion of the ego vehicle over a recording; `None` where it cannot be estimated.
#[derive(Clone, Debug, PartialEq)]
pub struct Driven {
    /// At each frame, over the frames around it.
    pub at: Vec<Option<OwnMotion>>,
    /// From each frame to the next.
    pub to_next: Vec<Option<OwnMotion>>,
}

/// The motion over all frames.
pub fn own_motion(standing: Vec<Standing>, times: &[f64]) -> Driven {
    let frames = standing.len();
    let seen: Vec<Seen> = standing.into_par_iter().map(Seen::new).collect();
    let pair = |i: usize| {
        // References: of the frames far in time, those with the most edges at the same places.
        let far = (0..frames).filter(|&j| (times[j] - times[i]).abs() > ELSEWHERE_S);
        let mut far: Vec<&Seen> = some_of(&far.map(|j| &seen[j]).collect::<Vec<_>>(), REFERENCES);
        far.sort_by_cached_key(|other| std::cmp::Reverse(seen[i].taken.in_common(&other.taken)));
        let [one, other, ..] = far[..] else { return None };
        Some(Pair::new(&seen[i], &seen[i + 1], [one, other], times[i + 1] - times[i]))
    };
    let pairs: Option<Vec<Pair>> = (0..frames.saturating_sub(1)).into_par_iter().map(pair).collect();
    let known = pairs.and_then(|pairs| speeds(&pairs).map(|speeds| (pairs, speeds)));
    let Some((pairs, speeds)) = known else {
        return Driven { at: vec![None; frames], to_next: vec![None; frames.saturating_sub(1)] };
    };
    let steps: Vec<Option<OwnMotion>> = pairs.par_iter().zip(speeds).map(|(pair, k)| pair.motion(k)).collect();
    let raw: Vec<Option<OwnMotion>> = (0..frames)
        .map(|i| {
            let before = i.checked_sub(1).and_then(|j| steps[j]);
            let after = steps.get(i).copied().flatten();
            match (before, after) {
                (Some(a), Some(b)) => Some(OwnMotion {
                    velocity_m_s: (a.velocity_m_s + b.velocity_m_s) / 2.0,
                    turn_rate_rad_s: (a.turn_rate_rad_s + b.turn_rate_rad_s) / 2.0,
                }),
                (one, None) | (None, one) => one,
            }
        })
        .collect();
    let at = smooth(&raw, times);
    let to_next = if at.iter().any(Option::is_some) { smooth_steps(&steps, times) } else { vec![None; steps.len()] };
    Driven { at, to_next }
}

/// Smallest share of frames with a known motion.
const KNOWN: f64 = 0.4;

/// Time within which a vehicle may change its speed by a fifth, s.
const STEADY_S: f64 = 0.8;

/// Time within which a vehicle may turn in or out of a bend, s.
const STRAIGHT_S: f64 = 0.4;

/// Medians of the motions within [`STEADY_S`] and of the frames before and after, where at least two are known; nothing
/// where too few are known.
fn smooth(raw: &[Option<OwnMotion>], times: &[f64]) -> Vec<Option<OwnMotion>> {
    let known = raw.iter().flatten().count();
    if (known as f64) < KNOWN * raw.len() as f64 || known < 3 {
        return vec![None; raw.len()];
    }
    let beside = |i: usize, j: usize| i.abs_diff(j) <= 1 || (times[j] - times[i]).abs() < STEADY_S;
    let of_frame = |i: usize| {
        let near: Vec<OwnMotion> = (0..raw.len()).filter(|&j| beside(i, j)).filter_map(|j| raw[j]).collect();
        (near.len() >= 2).then(|| usual(&near))
    };
    (0..raw.len()).map(of_frame).collect()
}

/// Medians of the motions from frame to frame: of speeds within [`STEADY_S`], of turns within [`STRAIGHT_S`].
fn smooth_steps(steps: &[Option<OwnMotion>], times: &[f64]) -> Vec<Option<OwnMotion>> {
    let apart_s = |i: usize, j: usize| 0.5 * (times[j] + times[j + 1] - times[i] - times[i + 1]).abs();
    let within = |i: usize, most_s: f64| {
        let near = (0..steps.len()).filter(|&j| apart_s(i, j) < most_s).filter_map(|j| steps[j]);
        usual(&near.collect::<Vec<_>>())
    };
    let of_step = |i: usize| {
        steps[i]?;
        Some(OwnMotion { turn_rate_rad_s: within(i, STRAIGHT_S).turn_rate_rad_s, ..within(i, STEADY_S) })
    };
    (0..steps.len()).map(of_step).collect()
}

/// Component by component, the median.
fn usual(motions: &[OwnMotion]) -> OwnMotion {
    let usual = |of: fn(&OwnMotion) -> Vector3<f64>| {
        Vector3::from_fn(|k, _| median(motions.iter().map(|m| of(m)[k]).collect()))
    };
    OwnMotion { velocity_m_s: usual(|m| m.velocity_m_s), turn_rate_rad_s: usual(|m| m.turn_rate_rad_s) }
}

/// Largest range of an edge, m.
const EDGES_M: f64 = 70.0;

/// Distance from a labelled object within which an edge may be of it, m.
const NEAR_OBJECT_M: f64 = 1.0;

/// Places of static edges, one of a cell, from returns at edges of standing surfaces: place in the cloud's frame and
/// range, m. Those near labelled objects are left out.
fn static_edges(returns: impl IntoIterator<Item = (Vector3<f64>, f64)>, boxes: &[Box3]) -> Vec<Vector2<f64>> {
    let near = |b: &Box3, p: [f64; 3]| {
        let local = b.to_local(p);
        (0..2).all(|k| local[k].abs() < b.size[k] / 2.0 + NEAR_OBJECT_M)
    };
    let mut cells = BTreeSet::new();
    let mut points = Vec::new();
    for (p, _) in returns.into_iter().filter(|(_, range_m)| *range_m <= EDGES_M) {
        if !boxes.iter().any(|b| near(b, p.into())) && cells.insert(cell(&p.xy())) {
            points.push(p.xy());
        }
    }
    points
}

/// Times of the frames from their ids: numbers of scans, or nanoseconds where neighbours differ by 1e6 or more.
/// `None` unless ids are rising numbers.
pub fn times_s(ids: &[String], rate_hz: f64) -> Option<Vec<f64>> {
    let numbers: Vec<f64> = ids.iter().map(|id| id.parse::<f64>().ok()).collect::<Option<_>>()?;
    if numbers.windows(2).any(|w| w[1] <= w[0]) {
        return None;
    }
    let gaps: Vec<f64> = numbers.windows(2).map(|w| w[1] - w[0]).collect();
    let usual = median_upper(gaps)?;
    let unit = if usual >= 1e6 { 1e-9 } else { 1.0 / rate_hz };
    Some(numbers.iter().map(|n| (n - numbers[0]) * unit).collect())
}

/// The median; 0 without values.
fn median(values: Vec<f64>) -> f64 {
    median_upper(values).unwrap_or(0.0)
}

fn cell(p: &Vector2<f64>) -> (i32, i32) {
    ((p.x / CELL_M).floor() as i32, (p.y / CELL_M).floor() as i32)
}

/// Edges in bird's-eye view, and the cells that they occupy; the ground.
struct Seen {
    edges: Vec<Vector2<f64>>,
    taken: Cells,
    ground: Ground,
}

impl Seen {
    fn new(standing: Standing) -> Self {
        let Standing { edges, ground } = standing;
        Seen { taken: Cells::new(&edges), edges, ground: Ground::new(ground) }
    }
}

/// Every so many of the values, so that at most `most` are left.
fn some_of<T: Copy>(values: &[T], most: usize) -> Vec<T> {
    values.iter().step_by(values.len().div_ceil(most).max(1)).copied().collect()
}

/// Two consecutive frames, and two reference frames from elsewhere. Matches with the references are due to the scan
/// pattern, which is static in the frame of the vehicle, and to walls, which look alike along their length.
struct Pair<'a> {
    some: Vec<Vector2<f64>>,
    first: &'a Seen,
    second: &'a Seen,
    /// Cells of the second frame and of the two references.
    cells: OfThree,
    dt: f64,
    /// By speed: excess of matches with the second frame over the references at the best turn, that turn, and the
    /// excess of one reference over the other, which is chance.
    scores: Vec<[f64; 3]>,
}

impl<'a> Pair<'a> {
    fn new(first: &'a Seen, second: &'a Seen, elsewhere: [&'a Seen; 2], dt: f64) -> Self {
        let some = some_of(&first.edges, SOME);
        let cells = OfThree::new([second, elsewhere[0], elsewhere[1]].map(|frame| &frame.edges[..]));
        let mut pair = Pair { some, first, second, cells, dt, scores: vec![[0.0; 3]; SPEEDS] };
        if first.edges.len() >= FEWEST && second.edges.len() >= FEWEST && dt > 0.0 && dt <= LONGEST_S {
            let yaw_steps = (SHARPEST_RAD_S * dt / 0.009).ceil() as i32;
            let mut best = [[f64::NEG_INFINITY, 0.0, f64::NEG_INFINITY]; SPEEDS];
            for step in -yaw_steps..=yaw_steps {
                let yaw = SHARPEST_RAD_S * dt * f64::from(step) / f64::from(yaw_steps.max(1));
                let turned = Turned::new(&pair.some, yaw);
                for (k, best) in best.iter_mut().enumerate() {
                    let [more, chance] = pair.more(&turned, SPEED_M_S * k as f64 * dt);
                    if more > best[0] {
                        (best[0], best[1]) = (more, yaw);
                    }
                    best[2] = best[2].max(chance);
                }
            }
            pair.scores = best.to_vec();
        }
        pair
    }

    /// Excess of the matches with the second frame over those with the references, and of one of these over the other.
    fn more(&self, turned: &Turned, way_m: f64) -> [f64; 2] {
        let [on, one, other] = turned.on(&self.cells, way_m);
        [on - 0.5 * (one + other), one - other]
    }

    /// The motion about grid speed `k`; `None` without an excess of matches.
    fn motion(&self, k: usize) -> Option<OwnMotion> {
        let [best, yaw, _] = self.scores[k];
        let mut sum = [0.0; 3];
        for j in -4..=4 {
            let yaw = yaw + 0.0015 * f64::from(j);
            let turned = Turned::new(&self.some, yaw);
            for i in -6..=6 {
                let d = SPEED_M_S * k as f64 * self.dt + 0.05 * f64::from(i);
                let weight = (self.more(&turned, d)[0] - 0.7 * best).max(0.0).powi(2);
                sum = [sum[0] + weight, sum[1] + weight * d, sum[2] + weight * yaw];
            }
        }
        if best <= 0.0 || sum[0] <= 0.0 {
            return None;
        }
        let (d, yaw) = (sum[1] / sum[0], sum[2] / sum[0]);
        let [climb_m, roll, pitch] = tilt(&self.first.ground, &self.second.ground, d, yaw).unwrap_or_default();
        Some(OwnMotion {
            velocity_m_s: Vector3::new(d, 0.0, climb_m) / self.dt,
            turn_rate_rad_s: Vector3::new(roll, pitch, yaw) / self.dt,
        })
    }
}

/// Index of the speed of every pair: the path with the most matches whose accelerations are possible. `None` where a
/// path by chance scores as well, or where speeds are at the lower end of the grid, which is due to parts that move
/// with the vehicle.
fn speeds(pairs: &[Pair]) -> Option<Vec<usize>> {
    let (speeds, sum) = path(pairs, 0)?;
    let (_, by_chance) = path(pairs, 2)?;
    let usual = median(speeds.iter().map(|k| *k as f64).collect());
    (sum > STANDS_OUT * by_chance.max(1.0) && usual > SLOWEST as f64 + 2.0).then_some(speeds)
}

/// The path of speeds on which one of the scores has the largest sum, and that sum.
fn path(pairs: &[Pair], score: usize) -> Option<(Vec<usize>, f64)> {
    // Best sum that ends at each speed, and from where.
    let mut best: Vec<f64> = vec![0.0; SPEEDS];
    let mut from: Vec<Vec<usize>> = Vec::new();
    for pair in pairs {
        let reach = (HARDEST_M_S2 * pair.dt.abs() / SPEED_M_S).ceil().min(SPEEDS as f64) as usize;
        let before = |k: usize| {
            let near = k.saturating_sub(reach).max(SLOWEST)..(k + reach + 1).min(SPEEDS);
            near.max_by(|&a, &b| best[a].total_cmp(&best[b])).unwrap_or(SLOWEST)
        };
        let came: Vec<usize> = (0..SPEEDS).map(before).collect();
        // The median over speeds is subtracted: only differences count.
        let middle = median(pair.scores[SLOWEST..].iter().map(|s| s[score]).collect());
        best = came.iter().zip(&pair.scores).map(|(&k, s)| best[k] + s[score] - middle).collect();
        from.push(came);
    }
    let last = (SLOWEST..SPEEDS).max_by(|&a, &b| best[a].total_cmp(&best[b]))?;
    let back = from.iter().rev().scan(last, |k, came| {
        let here = *k;
        *k = came[here];
        Some(here)
    });
    let mut speeds: Vec<usize> = back.collect();
    speeds.reverse();
    Some((speeds, best[last]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    #[test]
    fn posts_give_the_motion_and_walls_do_not() {
        let posts: Vec<Vector2<f64>> = (0..60)
            .map(|i| {
                Vector2::new(-60.0 + 2.2 * f64::from(i) + f64::from(i * i % 7) * 0.23, f64::from(i % 5) * 2.1 - 9.3)
            })
            .collect();
        let (d, yaw): (f64, f64) = (2.4, 0.012);
        let moved: Vec<Vector2<f64>> = posts
            .iter()
            .map(|p| {
                let (ms, mc) = (0.5 * yaw).sin_cos();
                let q = Vector2::new(p.x - d * mc, p.y - d * ms);
                Vector2::new(yaw.cos() * q.x + yaw.sin() * q.y, -yaw.sin() * q.x + yaw.cos() * q.y)
            })
            .collect();
        let seen = |edges: Vec<Vector2<f64>>| Seen::new(Standing { edges, ground: Vec::new() });
        let mut rng = data::stream(0, "elsewhere", 0, 0);
        let mut scattered = |n: usize, across_m: f64| {
            let mut at = |half: f64| if half > 0.0 { rng.random_range(-half..half) } else { 8.0 };
            seen((0..n).map(|_| Vector2::new(at(70.0), at(across_m))).collect())
        };
        let (first, second) = (seen(posts), seen(moved));
        let [one, other] = [scattered(60, 10.0), scattered(60, 10.0)];
        let pair = Pair::new(&first, &second, [&one, &other], 0.05);
        let motion = pair.motion(speeds(std::slice::from_ref(&pair)).unwrap()[0]).unwrap();
        assert!((motion.speed_m_s() - 48.0).abs() < 3.0 && (motion.turn_rate_rad_s.z - 0.24).abs() < 0.1, "{motion:?}");
        // Each scan samples a wall at other places.
        let walls: Vec<Seen> = (0..12).map(|_| scattered(400, 0.0)).collect();
        let pair = |i: usize| Pair::new(&walls[i], &walls[i + 1], [&walls[(i + 5) % 12], &walls[(i + 7) % 12]], 0.25);
        assert_eq!(speeds(&(0..11).map(pair).collect::<Vec<_>>()), None);
    }

    #[test]
    fn ids_are_scans_or_nanoseconds() {
        let ids = |v: &[&str]| v.iter().map(|s| s.to_string()).collect::<Vec<_>>();
        assert_eq!(times_s(&ids(&["000005", "000010"]), 20.0), Some(vec![0.0, 0.25]));
        let stamps = times_s(&ids(&["1650000000000000000", "1650000000050000000"]), 20.0).unwrap();
        assert!((stamps[1] - 0.05).abs() < 1e-4);
        assert_eq!(times_s(&ids(&["a", "b"]), 20.0), None);
        assert_eq!(times_s(&ids(&["3", "3"]), 20.0), None);
    }
}
