//! The correction of a law's form: no sensor has exactly the form of a law.

use super::Search;
use crate::channels::cells::{OBJECT, ROUND_COS, cell, place_of, zone};
use crate::channels::hits::{TOGETHER, counted};
use crate::channels::mean::origins;
use crate::inference::law::{FittedLaw, Law};
use crate::inference::losses::{FORM_BIN, LossTable};
use crate::pairing::{FramePair, Ray};
use nalgebra::Point3;
use rayon::prelude::*;
use sensor::Rig;
use sensor::directions::{FarSurfaces, is_level};
use sensor::effects::interpolated;

/// A correction: a table over the covariate.
#[derive(Clone, Debug, Default)]
pub(super) struct Form {
    /// Values of the covariate, ascending.
    pub(super) at: Vec<f64>,
    /// Factor at each of them.
    pub(super) factor: Vec<f64>,
}

impl Form {
    /// The factor at a value of the covariate; 1 without any.
    pub(super) fn at(&self, x: f64) -> f64 {
        if self.at.is_empty() { 1.0 } else { interpolated(&self.at, &self.factor, x) }
    }
}

/// Number of points of the correction of a law's form.
const FORM_BINS: f64 = 24.0;

/// Fewest returns, weighted by what they tell, of a point of the correction.
const FEWEST_OF_FORM: f64 = 40.0;

/// Expected returns that count as the prior of a factor of 1.
const FORM_PRIOR: f64 = 20.0;

/// Corrections of a law.
#[derive(Default)]
pub(super) struct Corrections {
    /// Of its form.
    pub(super) form: Form,
    /// Beyond it, where the angle of incidence is estimated: on the ground, standing surfaces and objects.
    pub(super) fitted: [Form; 3],
    /// The same where no surface can be fitted, but one of other returns goes on.
    pub(super) continued: [Form; 3],
    /// Share kept in place of the law at other edges, off and of objects, over ln(range in m).
    pub(super) edges: [Form; 2],
}

/// A shot with a return on a side, and what is expected of it.
#[derive(Clone, Copy)]
struct Shot {
    /// Covariate of the law.
    x: f32,
    /// Share that is expected to be measured.
    expected: f32,
    /// Variance of that by chance, if returns were lost independently.
    variance: f32,
    /// Whether it is measured.
    measured: bool,
}

/// A point of a correction.
struct Point {
    x: f64,
    factor: f64,
    /// Variance of the factor by chance.
    variance: f64,
}

/// Kinds of surfaces with corrections of their own, in the order of the fields of [`Corrections`].
const KINDS: usize = 8;

/// The surface of a ray, and what is known of it.
struct Met {
    /// Its place among the [`KINDS`].
    kind: usize,
    /// Its zone in the cells.
    zone: usize,
    /// Cosine of the angle of incidence; `None` where it is not known.
    cos: Option<f64>,
}

/// Finds the surfaces of the rays of one frame.
struct Surfaces {
    /// Those that go on beyond the simulated returns of each sensor.
    far: Vec<FarSurfaces>,
    origins: Vec<Point3<f64>>,
}

impl Surfaces {
    fn of(frame: &FramePair, rig: &Rig) -> Surfaces {
        let origins = origins(rig);
        let far = |(sensor, origin): (usize, &Point3<f64>)| {
            let smooth = frame.simulated.iter().filter(|r| r.smooth && usize::from(r.sensor) == sensor);
            FarSurfaces::new(smooth.map(|ray| (place(ray, origin), ray.normal)))
        };
        Surfaces { far: origins.iter().enumerate().map(far).collect(), origins }
    }

    /// The surface that a ray meets; `None` where there is nothing.
    fn met(&self, ray: &Ray) -> Option<Met> {
        let zone = zone(ray)?;
        if ray.smooth {
            let cos = f64::from(ray.cos_incidence).max(1e-4);
            return Some(Met { kind: zone.min(OBJECT), zone, cos: Some(cos) });
        }
        let sensor = usize::from(ray.sensor);
        let point = place(ray, &self.origins[sensor]);
        let through = self.far[sensor].through(point, ray.direction, ray.own_range_m() as f32);
        Some(match through {
            Some((normal, cos)) => {
                let of_scene = || if is_level(normal[2].into()) { 0 } else { 1 };
                let zone = if zone >= OBJECT { zone } else { of_scene() };
                Met { kind: 3 + zone.min(OBJECT), zone, cos: Some(cos.into()) }
            }
            None => Met { kind: 6 + usize::from(zone >= OBJECT), zone, cos: None },
        })
    }
}

/// Where a return lies, in the cloud's frame, m.
fn place(ray: &Ray, origin: &Point3<f64>) -> [f32; 3] {
    ray.point(origin).cast::<f32>().into()
}

impl Search<'_> {
    /// Corrections of law `k`.
    pub(super) fn corrections(&self, k: usize, laws: &[FittedLaw], table: &LossTable) -> Corrections {
        let form = self.form(k, laws, table);
        if laws[k].law == Law::Range {
            return Corrections { form, ..Corrections::default() };
        }
        let [a, b, c, d, e, f, g, h] = self.by_kind(k, laws, &form);
        Corrections { form, fitted: [a, b, c], continued: [d, e, f], edges: [g, h] }
    }

    /// Ratio of the measured share to that of the laws along the covariate of law `k`, return by return on all frames
    /// that are not held out: the correction of its form. Ratios are drawn towards 1 as far as chance alone makes them
    /// differ. Edges tell nothing: their incidence is not known.
    fn form(&self, k: usize, laws: &[FittedLaw], table: &LossTable) -> Form {
        let unmatched = table.unmatched(&[]);
        let tells = |ray: &Ray| {
            let (range_m, cos, zone) = place_of(ray).filter(|_| ray.smooth)?;
            let kept: f64 = laws.iter().map(|law| law.at(range_m, cos, zone).1).product();
            let expected = (kept * (1.0 - unmatched[cell(ray)?][1])).clamp(0.0, 1.0) as f32;
            let x = laws[k].at(range_m, cos, zone).0 as f32;
            Some(Shot { x, expected, variance: expected * (1.0 - expected), measured: ray.matched })
        };
        let points = points(self.fitted().flat_map(|f| &f.simulated).filter(|r| !self.mask.hides(r)).filter_map(tells));
        drawn(&points)
    }

    /// The same by kind of surface for clouds whose angles of incidence are estimated: an estimate is wrong otherwise
    /// across a kerb than on a curved body, and at edges there is none. On surfaces beyond the law and its form, at
    /// edges over ln(range) in place of the law.
    fn by_kind(&self, k: usize, laws: &[FittedLaw], form: &Form) -> [Form; KINDS] {
        let of_frame = |frame: &FramePair| {
            let surfaces = Surfaces::of(frame, self.context.rig);
            let mut shots: [Vec<Shot>; KINDS] = Default::default();
            for ([simulated, measured], ray) in counted(frame).filter(|(_, r)| !self.mask.hides(r)) {
                let Some(met) = surfaces.met(ray) else { continue };
                let (range_m, cos) = (f64::from(ray.range_m).max(0.1), met.cos.unwrap_or(ROUND_COS));
                let others = laws.iter().enumerate().filter(|(i, _)| *i != k);
                let by_others: f64 = others.map(|(_, law)| law.at(range_m, cos, met.zone).1).product();
                let (x, by_law) = laws[k].at(range_m, cos, met.zone);
                let (x, kept) = if met.cos.is_some() { (x, by_law * form.at(x)) } else { (range_m.ln(), 1.0) };
                shots[met.kind].push(Shot {
                    x: x as f32,
                    expected: if simulated { (by_others * kept).clamp(0.0, 1.0) as f32 } else { 0.0 },
                    variance: if simulated == measured { 0.0 } else { 1.0 },
                    measured,
                });
            }
            shots
        };
        let frames: Vec<&FramePair> = self.fitted().collect();
        let shots: Vec<_> = frames.into_par_iter().map(of_frame).collect();
        std::array::from_fn(|kind| drawn(&points(shots.iter().flat_map(|frame| frame[kind].iter().copied()))))
    }

    /// Frames that are not held out.
    fn fitted(&self) -> impl Iterator<Item = &FramePair> {
        self.select.iter().chain(&self.estimate).map(|&i| &self.context.frames[i])
    }
}

/// Ratios of what is measured to what is expected along the covariate, with as many bins as the counts determine to a
/// few per cent, where the law changes.
fn points(shots: impl Iterator<Item = Shot>) -> Vec<Point> {
    let mut shots: Vec<Shot> = shots.collect();
    shots.sort_by(|a, b| a.x.total_cmp(&b.x));
    let worth = |t: &Shot| f64::from(t.expected) * (1.02 - f64::from(t.expected));
    let per = (shots.iter().map(worth).sum::<f64>() / FORM_BINS).max(FEWEST_OF_FORM);
    let (mut points, mut bin) = (Vec::<Point>::new(), [0.0f64; 5]);
    let mut from = shots.first().map_or(0.0, |first| first.x);
    for (i, t) in shots.iter().enumerate() {
        let (expected, measured) = (f64::from(t.expected), f64::from(u8::from(t.measured)));
        let own = [expected * f64::from(t.x), expected, measured, worth(t), t.variance.into()];
        bin.iter_mut().zip(own).for_each(|(sum, v)| *sum += v);
        // Where a law keeps nearly all, few returns tell much, and one factor for all hides what it is at the end.
        let next = shots.get(i + 1);
        let ends = f64::from(t.x - from) > FORM_BIN || next.is_none();
        if next.is_none_or(|next| next.x > t.x) && (bin[3] >= per || ends && bin[3] >= FEWEST_OF_FORM) {
            from = t.x;
            let [at, expected, measured, _, variance] = bin;
            let x = at / expected;
            // Apart as far as files tell them apart.
            if points.last().is_none_or(|last| x > last.x + 2e-5) {
                let factor = (measured + FORM_PRIOR) / (expected + FORM_PRIOR);
                points.push(Point { x, factor, variance: TOGETHER * (variance + 1.0) / expected.powi(2) });
            }
            bin = [0.0; 5];
        }
    }
    points
}

/// Points whose factors are drawn towards 1.
fn drawn(points: &[Point]) -> Form {
    let weight = shrinkage(points);
    let factor = points.iter().map(|p| 1.0 + (p.factor - 1.0) * weight(p.variance)).collect();
    Form { at: points.iter().map(|p| p.x).collect(), factor }
}

/// Weight of a factor with some variance beside the prior that all are 1 but for a variance of their own, which is that
/// of the factors without what chance makes (the estimate of moments for a known mean, DerSimonian and Laird 1986).
fn shrinkage(points: &[Point]) -> impl Fn(f64) -> f64 {
    let sum = |of: &dyn Fn(f64) -> f64| points.iter().map(|p| of(p.factor - 1.0) / p.variance).sum::<f64>();
    let own = ((sum(&|d| d * d) - points.len() as f64) / sum(&|_| 1.0).max(1e-12)).max(0.0);
    move |by_chance| own / (own + by_chance)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn returns_with_one_value_of_the_covariate_are_one_point() {
        let shot = |k: u32| Shot { x: -0.5, expected: 0.9, measured: !k.is_multiple_of(4), variance: 0.25 };
        let points = points((0..20_000).map(shot));
        assert_eq!(points.len(), 1);
        assert!((points[0].x + 0.5).abs() < 1e-9 && (points[0].factor - 0.75 / 0.9).abs() < 1e-3);
    }

    #[test]
    fn factors_that_chance_explains_become_1_and_others_stay() {
        let point = |d: f64, k: i32| Point { x: f64::from(k), factor: 1.0 + d * f64::from(k % 3 - 1), variance: 1e-4 };
        let off = |d: f64| (0..24).map(|k| point(d, k)).collect::<Vec<_>>();
        assert!(shrinkage(&off(0.01))(1e-4) < 0.1);
        assert!(shrinkage(&off(0.1))(1e-4) > 0.95);
        assert_eq!(shrinkage(&[])(1e-4), 0.0);
    }
}
