//! Labelled objects from frame to frame.

use super::{LONGEST_S, OwnMotion};
use geometry::Box3;
use nalgebra::{Rotation2, Vector2, Vector3};

/// Largest speed of an object over the ground, m/s; backwards and forwards.
const FASTEST_M_S: [f64; 2] = [5.0, 60.0];

/// Distance across its heading within which an object may be that of another frame, m, and its growth with the
/// distance along it.
const ACROSS_M: [f64; 2] = [0.6, 0.15];

/// Longest time to another frame without the motion of the ego vehicle, s.
const UNGUIDED_S: f64 = 0.6;

/// Largest distance of an object from its place in another frame without that motion, m.
const UNGUIDED_M: f64 = 5.0;

/// How many metres of distance a metre of different size counts like. An object keeps its size.
const SIZE_COUNTS: f64 = 20.0;

/// Largest change of an object's speed from the way to a frame to the way from it that is always possible, m/s, and
/// its growth with the time between these, m/s2.
const CHANGES: [f64; 2] = [2.0, 8.0];

/// An object of another frame that may be the same as one of this frame.
#[derive(Clone, Copy)]
struct Same {
    /// Later by so much, s.
    dt: f64,
    /// Moved by so much relative to the ego vehicle, m.
    moved: Vector3<f64>,
    /// Velocity along its heading over the ground, m/s; relative to the ego vehicle where its motion is not known.
    speed_m_s: f64,
    /// Whether the motion of the ego vehicle is known.
    over_ground: bool,
    /// How unlike it is: the way over the ground, and the difference of the sizes, m.
    unlike_m: f64,
}

/// Velocity of a labelled object.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SeenVelocity {
    /// Relative to the ego vehicle, m/s, cloud's frame.
    pub relative_m_s: Vector3<f64>,
    /// Along its heading over the ground, m/s, where the motion of the ego vehicle is known.
    pub speed_m_s: Option<f64>,
}

/// Velocity of a box of frame `f`, from the same object in the frames before and after. `boxes` gives those of a frame,
/// `to_next` is the motion of the ego vehicle from each frame to the next. The same object is one of that size which
/// has moved least over the ground along its heading; without the motion of the ego vehicle, the one nearest to its
/// place. `None` where there is none, or where it would have changed its speed faster than vehicles do.
pub fn seen_velocity(
    boxes: &dyn Fn(usize) -> Vec<Box3>,
    times: &[f64],
    f: usize,
    bbox: &Box3,
    to_next: &[Option<OwnMotion>],
) -> Option<SeenVelocity> {
    let candidates = |g: usize| -> Vec<Same> {
        let own = to_next.get(f.min(g)).copied().flatten();
        let dt = times[g] - times[f];
        let longest_s = if own.is_some() { LONGEST_S } else { UNGUIDED_S };
        // Times are sums of steps.
        let near = dt.abs() < longest_s + 1e-3;
        boxes(g).iter().filter(|_| near).filter_map(|b| same(bbox, b, dt, own)).collect()
    };
    let before = f.checked_sub(1).map_or(vec![], candidates);
    let after = if f + 1 < times.len() { candidates(f + 1) } else { vec![] };
    let least = |all: &[Same]| all.iter().copied().min_by(|a, b| a.unlike_m.total_cmp(&b.unlike_m));
    if before.is_empty() || after.is_empty() {
        return least(&[before, after].concat())
            .map(|s| SeenVelocity { relative_m_s: s.moved / s.dt, speed_m_s: s.over_ground.then_some(s.speed_m_s) });
    }
    let change = |[a, b]: &[Same; 2]| (b.speed_m_s - a.speed_m_s).abs();
    let unlike = |both: &[Same; 2]| both[0].unlike_m + both[1].unlike_m + change(both) * (both[1].dt - both[0].dt);
    let pairs = before.iter().flat_map(|a| after.iter().map(|b| [*a, *b]));
    let best = pairs.min_by(|a, b| unlike(a).total_cmp(&unlike(b)))?;
    let [a, b] = best;
    let possible = change(&best) < CHANGES[0] + CHANGES[1] * 0.5 * (b.dt - a.dt);
    possible.then(|| SeenVelocity {
        relative_m_s: (b.moved - a.moved) / (b.dt - a.dt),
        speed_m_s: (a.over_ground && b.over_ground)
            .then_some((a.speed_m_s * a.dt - b.speed_m_s * b.dt) / (a.dt - b.dt)),
    })
}

/// A box of another frame, `dt` later (s), as the same object; `None` where it cannot be. `own` is the motion of the
/// ego vehicle between both.
fn same(bbox: &Box3, other: &Box3, dt: f64, own: Option<OwnMotion>) -> Option<Same> {
    let like = (0..3).all(|k| (other.size[k] - bbox.size[k]).abs() < 0.35 * bbox.size[k]);
    let moved = Vector3::from(other.center) - Vector3::from(bbox.center);
    let other_size_m = (0..3).map(|k| (other.size[k] - bbox.size[k]).abs()).sum::<f64>();
    let [backwards, forwards] = FASTEST_M_S;
    // Where it would be if it stood, in the later frame: the vehicle moves along its mean heading.
    let (turned, carried) = own.map_or((0.0, Vector2::zeros()), |own| {
        let turned = own.turn_rate_rad_s.z * dt;
        (turned, Rotation2::new(0.5 * turned) * own.velocity_m_s.xy() * dt)
    });
    let standing = Rotation2::new(-turned) * (Vector2::new(bbox.center[0], bbox.center[1]) - carried);
    let there = Vector2::new(other.center[0], other.center[1]);
    let away = Rotation2::new(turned - bbox.yaw_rad) * (there - standing);
    let speed_m_s = away.x / dt;
    let possible = match own {
        Some(_) => {
            (-backwards..forwards).contains(&speed_m_s) && away.y.abs() < ACROSS_M[0] + ACROSS_M[1] * away.x.abs()
        }
        None => moved.norm() < (forwards * dt.abs()).min(UNGUIDED_M),
    };
    let unlike_m = away.norm() + SIZE_COUNTS * other_size_m;
    (like && possible).then_some(Same { dt, moved, speed_m_s, over_ground: own.is_some(), unlike_m })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A turning vehicle between parked cars, 6 m apart; it moves 7.2 m from frame to frame. One car moves.
    #[test]
    fn objects_are_followed_over_the_ground() {
        let (dt, own) = (
            0.8,
            OwnMotion { velocity_m_s: Vector3::new(9.0, 0.0, 0.0), turn_rate_rad_s: Vector3::new(0.0, 0.0, 0.4) },
        );
        // Places in the frame of the vehicle at time 0.
        let parked: Vec<[f64; 2]> = (0..6).map(|k| [-12.0 + 6.0 * f64::from(k), 4.0]).collect();
        let speed = 8.0;
        let at = |t: f64, [x, y]: [f64; 2], length_m: f64| {
            let turned = own.turn_rate_rad_s.z * t;
            let moved = Rotation2::new(0.5 * turned) * own.velocity_m_s.xy() * t;
            let p = Rotation2::new(-turned) * (Vector2::new(x, y) - moved);
            Box3 { center: [p.x, p.y, 0.8], size: [length_m, 1.8, 1.5], yaw_rad: -turned }
        };
        let boxes = |f: usize| -> Vec<Box3> {
            let t = dt * (f as f64 - 1.0);
            let moving = at(t, [10.0 + speed * t, 0.5], 4.4);
            parked.iter().map(|p| at(t, *p, 4.2)).chain([moving]).collect()
        };
        let times = [0.0, dt, 2.0 * dt];
        for (number, bbox) in boxes(1).iter().enumerate() {
            let seen = seen_velocity(&boxes, &times, 1, bbox, &[Some(own); 2]).unwrap();
            let truth = if number == parked.len() { speed } else { 0.0 };
            assert!((seen.speed_m_s.unwrap() - truth).abs() < 0.1, "{number}: {seen:?}");
        }
        // Without the motion of the vehicle nothing is said of frames so far apart.
        assert_eq!(seen_velocity(&boxes, &times, 1, &boxes(1)[0], &[None; 2]), None);
    }
}
