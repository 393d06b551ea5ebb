//! A scan that takes its time: what stands still slides along the scan as the own car drives, by metres at speed. Looked for before all else,
//! since it shears whole scenes, and taken out for the other channels.
//!
//! For each time that a scan may take, measured returns are moved back to where they would be in the middle of the scan; counted are those that
//! then come to lie where the simulation has something, seen from above. No pairing of rays is needed, so that metres do not matter.

use super::{ChannelResult, Context, Found, REPETITIONS, Z_STAR, by_block, draw_blocks};
use crate::channels::labels::seen_velocity;
use crate::channels::mean::{common_bias_m, origins};
use crate::channels::motion::{CELL_M, Cells, OwnMotion};
use crate::diagnosis::{Considered, Curve, CurvePoint, Minimum, Parameter, Status};
use crate::inference::choice::{significant, total_and_z};
use crate::inference::median;
use crate::inference::roles::Role;
use crate::pairing::{FramePair, Ray, Surface};
use geometry::Box3;
use nalgebra::{Isometry3, Point3, Vector2, Vector3};
use rayon::prelude::*;
use sensor::{Rig, Sensor};

/// How the scene slides over a scan.
pub struct Slide {
    /// What a scan takes from phase -1/2 to +1/2, s.
    scan_s: f64,
    /// Of every frame: the own motion and the objects with what the own car sees of their motion, m/s.
    motions: Vec<Motion>,
    /// Every sensor, and its frame from the cloud's.
    sensors: Vec<(Sensor, Isometry3<f64>)>,
}

/// What moves in one frame.
struct Motion {
    own: OwnMotion,
    objects: Vec<(Box3, Vector3<f64>)>,
}

impl Motion {
    /// Velocity of what is at a point, as the own car sees it, m/s.
    fn at(&self, point: &Vector3<f64>, longest_s: f64) -> Vector3<f64> {
        let on = |(b, v): &&(Box3, Vector3<f64>)| {
            let local = b.to_local((*point).into());
            let margin = 0.5 + 0.5 * v.norm() * longest_s;
            (0..2).all(|k| local[k].abs() < b.size[k] / 2.0 + margin) && local[2].abs() < b.size[2] / 2.0 + 0.3
        };
        match self.objects.iter().find(on) {
            Some((_, v)) => *v,
            None => Vector3::new(
                -self.own.speed_m_s + self.own.yaw_rate_rad_s * point.y,
                -self.own.yaw_rate_rad_s * point.x,
                0.0,
            ),
        }
    }
}

impl Slide {
    /// How far a point of a frame that a sensor shows is from where it was in the middle of the scan, m, cloud's frame.
    pub fn shift_m(&self, frame: usize, point: &Vector3<f64>, sensor: usize) -> Vector3<f64> {
        let (mount, sensor_from_cloud) = &self.sensors[sensor];
        let [azimuth_rad, elevation_rad, _] = Sensor::spherical(&(sensor_from_cloud * Point3::from(*point)));
        let phase = mount.scan_phase(azimuth_rad, elevation_rad);
        self.motions[frame].at(point, self.scan_s.abs()) * (phase * self.scan_s)
    }
}

/// Returns of a frame that are moved.
const POINTS: usize = 2500;

/// Farther returns lie too thin, m.
const REACH_M: f64 = 60.0;

/// Steps to either side of what is tried: 5 ms, or 25 cm where the own speed is not known.
const STEPS: i32 = 28;
const STEP_S: f64 = 0.005;
const STEP_M: f64 = 0.25;

/// Slides of the whole scene by less than that are seen better by the surfaces, m.
const LEAST_M: f64 = 0.3;

/// What comes to lie on the simulation must be more by this share.
const LEAST_SHARE: f64 = 0.015;

/// Returns of one frame that may slide.
struct Sliders {
    occupied: Cells,
    /// Place, and how far it slides a second of scan, seen from above.
    points: Vec<(Vector2<f64>, Vector2<f64>)>,
    /// Measured returns that each of the points stands for.
    each: f64,
}

impl Sliders {
    fn new(frame: &FramePair, motion: &Motion, rig: &Rig, origins: &[Point3<f64>], longest: f64) -> Self {
        let at = |r: &Ray, off_m: f64| origins[r.sensor as usize] + r.direction_vector() * (r.own_range_m() - off_m);
        let near = |r: &&Ray| (3.0..REACH_M).contains(&r.own_range_m());
        let stands = |r: &&Ray| r.surface != Surface::Ground || !r.smooth || r.across_m() > 0.25;
        let simulated = frame.simulated.iter().filter(near).filter(|r| r.surface != Surface::Ground);
        let occupied = Cells::new(&simulated.map(|r| at(r, 0.0).coords.xy()).collect::<Vec<_>>());
        let measured: Vec<_> = frame.measured.iter().filter(near).filter(stands).collect();
        let stride = measured.len().div_ceil(POINTS).max(1);
        // Walls that are all seen nearer or farther slide nowhere.
        let bias_m = common_bias_m(frame);
        let points = measured.iter().step_by(stride).map(|r| {
            let p = at(r, bias_m).coords;
            let mount = &rig.sensors[r.sensor as usize];
            let phase = mount.scan_phase(f64::from(r.azimuth_rad), f64::from(r.elevation_rad));
            let slides = motion.at(&p, longest) * phase;
            (p.xy(), slides.xy())
        });
        Sliders { occupied, points: points.collect(), each: stride as f64 }
    }

    /// Number of the points that lie where the simulation has something if a scan takes `scan_s`.
    fn on(&self, scan_s: f64) -> f64 {
        let on = self.points.iter().filter(|(p, slides)| self.occupied.contains(&(p - slides * scan_s)));
        on.count() as f64
    }
}

/// Mean gain over its standard error from which on a slide may be one: whether the scene then comes to lie on the simulation is asked elsewhere.
const DOUBTFUL: f64 = 1.5;

/// What the search of a slide says.
pub enum Sliding {
    /// Nothing slides.
    No(ChannelResult),
    /// Everything slides.
    Yes(ChannelResult, Slide),
    /// So little is seen from above that the whole scene must be moved back to tell: what to say if it slides, and if not.
    Perhaps(ChannelResult, Slide, ChannelResult),
}

/// The search.
pub fn search(context: &Context) -> Sliding {
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let mut result = ChannelResult { distance: vec![[0.0; 3]; hold_out.len()], ..ChannelResult::default() };
    // Where the scenes tell the own motion, and where they do not: then all frames slide alike.
    let mut ways = vec![Way::unknown(context)];
    ways.extend(Way::known(context));
    let tried = ways.iter().map(|way| way.tried(&select)).collect::<Vec<_>>();
    let total = |k: usize| total_and_z(&tried[k].gains).0;
    let Some(k) = (0..ways.len()).max_by(|&a, &b| total(a).total_cmp(&total(b))) else { return Sliding::No(result) };
    let Tried { best, gains, least, most } = &tried[k];
    let way = ways.swap_remove(k);
    let (gain, z) = total_and_z(gains);
    let seen = significant(gains, Z_STAR) && gain > LEAST_SHARE * (most - gain);
    let far_enough = best.abs() * way.fastest > LEAST_M;
    let considered = |outcome: &str| Considered {
        cause: "rolling_shutter".into(),
        channel: "slide".into(),
        nats_per_ray: 0.0,
        z,
        outcome: outcome.into(),
    };
    let minimum = Minimum { parameter: "shear_x_m".into(), value: LEAST_M, unit: "m".into() };
    result.minimum.push(("rolling_shutter".into(), minimum));
    let outcome =
        if seen { "too small to be seen from above" } else { "no more returns come to lie on the simulation" };
    let none = ChannelResult { considered: vec![considered(outcome)], ..result.clone() };
    if !far_enough || !seen && z < DOUBTFUL {
        return Sliding::No(none);
    }
    result.considered.push(considered("chosen"));
    // Finer on other frames, with blocks drawn for the interval.
    let fine: Vec<f64> = (-20..=20).map(|k| best + 0.2 * way.step * f64::from(k)).collect();
    let on_estimate = way.counts(&estimate, &fine);
    let members = by_block(&context.blocks(&estimate));
    let mut rng = data::stream(0, "diagnose shutter", 0, 0);
    let all: Vec<usize> = (0..estimate.len()).collect();
    let scan_s = peak(&fine, &on_estimate, &all);
    let draws: Vec<f64> =
        (0..REPETITIONS).map(|_| peak(&fine, &on_estimate, &draw_blocks(&members, &mut rng))).collect();
    let spread = (draws.iter().map(|d| (d - scan_s).powi(2)).sum::<f64>() / draws.len() as f64).sqrt();
    // Cells have a size, and the own speed is not known better than by a few per cent.
    let error = spread.hypot(0.03 * scan_s).hypot(0.1 * CELL_M / way.fastest.max(1.0));
    // Chance puts some of the points onto the simulation whatever is done: what one more is worth follows from both shares.
    let points = |frames: &[usize]| frames.iter().map(|&f| way.sliders[f].points.len() as f64).sum::<f64>();
    let share = |on: f64| ((on + 1.0) / (points(&select) + 2.0)).clamp(0.01, 0.99);
    let [chance, there] = [*least, *most].map(share);
    let worth = (there * (1.0 - chance) / (chance * (1.0 - there))).ln().max(0.0);
    let held = hold_out.iter().map(|&f| {
        let sliders = &way.sliders[f];
        (sliders.on(scan_s) - sliders.on(0.0)) * sliders.each * worth
    });
    let held: Vec<f64> = held.collect();
    result.distance.iter_mut().zip(&held).for_each(|(d, g)| *d = [g.max(0.0), *g, g.max(0.0)]);
    let middle = median(way.motions.iter().map(|m| m.own.speed_m_s).collect());
    let parameter = |estimate: f64, error: f64, unit: &str| Parameter {
        estimate,
        unit: unit.into(),
        ci95: [estimate - 2.0 * error, estimate + 2.0 * error],
    };
    let share = |on: f64| on / points(&estimate).max(1.0);
    let [before, after] = [0.0, scan_s].map(|at| share(estimate.iter().map(|&f| way.sliders[f].on(at)).sum()));
    let curve = fine.iter().enumerate().map(|(k, s)| {
        let measured = share(on_estimate.iter().map(|counts| counts[k]).sum());
        CurvePoint { x: -s, measured, before, after, error: 0.0 }
    });
    let shear = ("shear_x_m".to_owned(), parameter(-middle * scan_s, middle * error, "m"));
    let times = way.speed_known.then(|| ("scan_s".to_owned(), parameter(-scan_s, error, "s"))).into_iter();
    let speed = if way.speed_known {
        format!(" at {middle:.0} m/s: a scan takes {:.0} ms", 1e3 * scan_s.abs())
    } else {
        String::new()
    };
    result.found.push(Found {
        status: Status::Named,
        causes: vec!["rolling_shutter".into()],
        family: "timing",
        // Scanners of this kind turn clockwise: positive.
        parameters: times.chain([shear]).collect(),
        confidence: draws.iter().filter(|d| d.signum() == scan_s.signum()).count() as f64 / draws.len() as f64,
        channel: "slide",
        covariate: "scan_phase".into(),
        held_out_gains: held,
        says: format!(
            "what stands still slides by {:.2} m over a scan{speed}, and nobody moves its points back; your simulator shoots all at once",
            (middle * scan_s).abs()
        ),
        separate_by: None,
        curve: Curve {
            x: if way.speed_known { "time that a scan takes, s" } else { "slide over a scan, m" }.into(),
            y: "share of standing returns on the simulation".into(),
            points: curve.collect(),
        },
    });
    let sensors = context.rig.sensors.iter().map(|s| (s.clone(), s.pose().inverse())).collect();
    let slide = Slide { scan_s, motions: way.motions, sensors };
    if seen { Sliding::Yes(result, slide) } else { Sliding::Perhaps(result, slide, none) }
}

/// One way to tell how things slide.
struct Way {
    motions: Vec<Motion>,
    sliders: Vec<Sliders>,
    /// Fastest own speed, m/s; 1 where it is not known: what is tried are then metres of slide.
    fastest: f64,
    step: f64,
    speed_known: bool,
}

impl Way {
    /// From the own motion and that of the objects, where the scenes tell both.
    fn known(context: &Context) -> Option<Way> {
        let (times, own) = (context.times.as_ref()?, context.motion.as_ref()?);
        let motion = |f: usize| {
            let boxes = context.frames[f].objects.iter().filter_map(|o| o.simulated);
            let moving = boxes.filter_map(|b| Some((b, seen_velocity(context.frames, times, f, &b)?)));
            let still = OwnMotion { speed_m_s: 0.0, yaw_rate_rad_s: 0.0 };
            Motion { own: own[f].unwrap_or(still), objects: moving.collect() }
        };
        let motions: Vec<Motion> = (0..context.frames.len()).map(motion).collect();
        let fastest = motions.iter().map(|m| m.own.speed_m_s.abs()).fold(0.0, f64::max);
        (fastest > 1.0).then(|| Way::new(context, motions, fastest, STEP_S, true))
    }

    /// All frames alike; objects stay where they are.
    fn unknown(context: &Context) -> Way {
        let motion = |frame: &FramePair| Motion {
            own: OwnMotion { speed_m_s: 1.0, yaw_rate_rad_s: 0.0 },
            objects: frame.objects.iter().filter_map(|o| Some((o.simulated?, Vector3::zeros()))).collect(),
        };
        Way::new(context, context.frames.iter().map(motion).collect(), 1.0, STEP_M, false)
    }

    fn new(context: &Context, motions: Vec<Motion>, fastest: f64, step: f64, speed_known: bool) -> Way {
        let origins = origins(context.rig);
        let longest = step * f64::from(STEPS);
        let of_frame = |(frame, motion)| Sliders::new(frame, motion, context.rig, &origins, longest);
        let sliders = context.frames.par_iter().zip(&motions).map(of_frame).collect();
        Way { motions, sliders, fastest, step, speed_known }
    }

    /// Of every frame the numbers that come to lie on the simulation, one by one of what is tried.
    fn counts(&self, frames: &[usize], tried: &[f64]) -> Vec<Vec<f64>> {
        frames.par_iter().map(|&f| tried.iter().map(|&s| self.sliders[f].on(s)).collect()).collect()
    }

    /// Tries all on these frames.
    fn tried(&self, frames: &[usize]) -> Tried {
        let grid: Vec<f64> = (-STEPS..=STEPS).map(|k| self.step * f64::from(k)).collect();
        let on = self.counts(frames, &grid);
        let sums: Vec<f64> = (0..grid.len()).map(|k| on.iter().map(|c| c[k]).sum()).collect();
        let still = STEPS as usize;
        let best = (0..grid.len()).max_by(|&a, &b| sums[a].total_cmp(&sums[b])).unwrap_or(still);
        Tried {
            best: grid[best],
            gains: on.iter().map(|c| c[best] - c[still]).collect(),
            least: sums.iter().copied().fold(f64::INFINITY, f64::min),
            most: sums[best],
        }
    }
}

/// What came of trying.
struct Tried {
    /// What is best.
    best: f64,
    /// How many more come to lie on the simulation on each frame.
    gains: Vec<f64>,
    /// How many come to lie there at least, whatever is tried, and how many at most.
    least: f64,
    most: f64,
}

/// The time at which most come to lie on the simulation: the mean of those within 15 % of the best, of what is between the worst and it.
fn peak(times: &[f64], counts: &[Vec<f64>], which: &[usize]) -> f64 {
    let sums: Vec<f64> = (0..times.len()).map(|k| which.iter().map(|&i| counts[i][k]).sum()).collect();
    let [low, high] = [sums.iter().copied().fold(f64::INFINITY, f64::min), sums.iter().copied().fold(0.0, f64::max)];
    let weight = |s: f64| (s - (high - 0.15 * (high - low))).max(0.0);
    let total: f64 = sums.iter().map(|s| weight(*s)).sum();
    sums.iter().zip(times).map(|(s, t)| weight(*s) * t).sum::<f64>() / total.max(1e-9)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::inference::roles::roles;
    use rand::RngExt;

    /// A return of something that stands.
    fn standing(at: &Vector3<f64>) -> Ray {
        Ray {
            sensor: 0,
            surface: Surface::Standing,
            smooth: true,
            corner: false,
            at_object: false,
            matched: true,
            company: 5,
            in_gap: false,
            row: 0,
            object: u16::MAX,
            azimuth_rad: at.y.atan2(at.x) as f32,
            elevation_rad: 0.0,
            range_m: at.norm() as f32,
            cos_incidence: 1.0,
            direction: at.normalize().cast::<f32>().into(),
            normal: [1.0, 0.0, 0.0],
            residual_m: 0.0,
            bulge_m: 0.0,
            leverage: 0.2,
            roughness_m: 0.0,
            roughness_leverage: 0.2,
            near_far_m: [at.norm() as f32; 2],
        }
    }

    /// Twenty frames of posts, seen at 40 m/s by a scan that takes `scan_s`, counter-clockwise.
    fn found(scan_s: f64) -> Option<f64> {
        let rig = Rig::single();
        let velocity = Vector3::new(-40.0, 0.0, 0.0);
        let frames: Vec<FramePair> = (0..20)
            .map(|f| {
                let mut rng = data::stream(f, "posts", 0, 0);
                let mut place = || rng.random_range(-45.0..45.0f64);
                let posts: Vec<Vector3<f64>> = (0..150).map(|_| Vector3::new(place(), place(), 0.0)).collect();
                let shown = |p: &Vector3<f64>| p + velocity * (p.y.atan2(p.x) / std::f64::consts::TAU * scan_s);
                FramePair {
                    mixed_per_rad: 0.0,
                    open: 0.0,
                    id: f.to_string(),
                    measured: posts.iter().map(|p| standing(&shown(p))).collect(),
                    simulated: posts.iter().map(standing).collect(),
                    objects: vec![],
                }
            })
            .collect();
        let own = OwnMotion { speed_m_s: 40.0, yaw_rate_rad_s: 0.0 };
        let context = Context {
            rig: &rig,
            frames: &frames,
            roles: roles(frames.len()),
            times: Some((0..20).map(|f| 0.05 * f64::from(f)).collect()),
            motion: Some(vec![Some(own); 20]),
        };
        let (result, slide) = match search(&context) {
            Sliding::Yes(result, slide) => (result, Some(slide)),
            Sliding::No(result) | Sliding::Perhaps(_, _, result) => (result, None),
        };
        assert_eq!(result.found.len(), usize::from(slide.is_some()));
        let p = Vector3::new(0.0, 20.0, 0.0);
        if let Some(slide) = slide {
            let shift = slide.shift_m(3, &p, 0);
            assert!((shift - velocity * (0.25 * slide.scan_s)).norm() < 1e-9, "{shift}");
        }
        let scan_s = &result.found.first()?.parameters[0].1;
        assert!(scan_s.ci95[0] < scan_s.estimate && scan_s.estimate < scan_s.ci95[1]);
        Some(-scan_s.estimate)
    }

    #[test]
    fn the_time_that_a_scan_takes_is_found_and_nothing_where_it_takes_none() {
        for truth in [-0.08, 0.05] {
            let estimate = found(truth).unwrap();
            assert!((estimate - truth).abs() < 0.003, "{estimate} {truth}");
        }
        assert_eq!(found(0.0), None);
    }
}
