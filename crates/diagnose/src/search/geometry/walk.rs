//! Range walk: ranges that depend on how bright a surface is. It is looked for before all else of geometry, between
//! bright and dark spots of one surface, which no pose and no error of the surfaces displaces against each other.

use crate::catalogue::sizes::WALK_M;
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::brightness::{BrightFrame, Brightnesses, bright_frames};
use crate::channels::mean::{usable, usual_noise_m};
use crate::channels::own_poses::{mounts, own_poses};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Minimum, Status};
use crate::inference::choice::{directions_agree, total_and_z};
use crate::inference::linear::{LinearFit, LinearFrame, cross_gains, fit};
use crate::inference::roles::Role;
use crate::pairing::{OCTANTS, Ray};
use crate::search::{ChannelResult, Context, Found, Z_STAR, first_demands, parameter};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use sensor::Effect;

/// Width of a point of the plot, ln.
const BIN_LN: f64 = 0.25;

/// Fewest returns of a point of the plot.
const FEWEST: f64 = 50.0;

/// A range walk that was found.
#[derive(Clone, Copy, Debug)]
pub struct Walk {
    brightness: Brightnesses,
    /// Change of range, m for each factor e of brightness.
    by_m: f64,
}

impl Walk {
    /// Error of the range of a measured return, m; 0 where its brightness is not known.
    pub fn of(&self, ray: &Ray) -> f64 {
        self.brightness.ln(ray).map_or(0.0, |bright| self.by_m * bright)
    }
}

/// Sums of all frames, with the brightness of surfaces.
struct Sums {
    brightness: Brightnesses,
    frames: Vec<BrightFrame>,
    /// The frames as a whole, in units of the variance that patches leave.
    whole: Vec<LinearFrame>,
    variance: f64,
}

impl Sums {
    /// `None` where intensities do not tell surfaces apart. The variance is that of the `train` frames.
    fn new(context: &Context, train: &[usize]) -> Option<Sums> {
        let brightness = Brightnesses::of(context.frames)?;
        let mounts = mounts(context.rig);
        let noise_m = usual_noise_m(context.frames);
        let poses: Vec<_> = context.frames.par_iter().map(|f| own_poses(f, &mounts, noise_m)).collect();
        let frames = bright_frames(context.frames, context.rig, &poses, &brightness, noise_m);
        let [squares, freedom] =
            train.iter().fold([0.0; 2], |s, &f| [s[0] + frames[f].squares, s[1] + frames[f].freedom]);
        let variance = (squares / freedom.max(1.0)).max(1.0);
        let whole = |f: &BrightFrame| of_one_column(sum_of(f.octants.iter()), variance);
        let whole = frames.iter().map(whole).collect();
        Some(Sums { brightness, frames, whole, variance })
    }

    fn fit(&self, context: &Context, which: &[usize]) -> LinearFit {
        let frames: Vec<&LinearFrame> = which.iter().map(|&f| &self.whole[f]).collect();
        fit(&frames, &context.blocks(which), &[0], &[0.0])
    }

    /// Sums of some frames by direction about the vehicle.
    fn octants(&self, which: &[usize]) -> Vec<LinearFrame> {
        let sums = (0..OCTANTS).map(|k| sum_of(which.iter().map(|&f| &self.frames[f].octants[k])));
        sums.map(|sums| of_one_column(sums, self.variance)).collect()
    }

    /// Standard error of a walk fitted on some frames, m: by the scatter of blocks of frames, or by that of directions,
    /// whichever is larger. Directions show other surfaces, whose brightness differs more or less: the law need not be
    /// a straight line in its logarithm.
    fn error_m(&self, fitted: &LinearFit, which: &[usize]) -> f64 {
        let octants = self.octants(which);
        let seen: Vec<&LinearFrame> = octants.iter().filter(|octant| octant.gram[(0, 0)] > 0.0).collect();
        let each: Vec<usize> = (0..seen.len()).collect();
        fitted.error(0).max(fit(&seen, &each, &[0], &[0.0]).error(0))
    }

    /// Gain of each direction by a walk fitted on some frames, and what it is expected to gain, nats.
    fn by_octant(&self, fitted: &LinearFit, which: &[usize]) -> [Vec<f64>; 2] {
        let octants = self.octants(which);
        let expected = |octant: &LinearFrame| 0.5 * octant.gram[(0, 0)] * fitted.theta[0].powi(2);
        [octants.iter().map(|octant| fitted.gain(octant)).collect(), octants.iter().map(expected).collect()]
    }
}

fn sum_of<'a>(all: impl Iterator<Item = &'a [f64; 2]>) -> [f64; 2] {
    all.fold([0.0; 2], |sum, one| [sum[0] + one[0], sum[1] + one[1]])
}

/// Sums of the only column, in units of a variance.
fn of_one_column([square, product]: [f64; 2], variance: f64) -> LinearFrame {
    LinearFrame {
        gram: DMatrix::from_element(1, 1, square / variance),
        right: DVector::from_element(1, product / variance),
    }
}

/// Gains of the `test` frames by a walk fitted on the `train` frames, nats.
pub fn by_table(context: &Context, train: &[usize], test: &[usize]) -> Vec<f64> {
    let Some(sums) = Sums::new(context, train) else { return vec![0.0; test.len()] };
    let fitted = sums.fit(context, train);
    test.iter().map(|&f| fitted.gain(&sums.whole[f])).collect()
}

/// The search, and what it found.
pub fn search(context: &Context) -> (ChannelResult, Option<Walk>) {
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|role| context.of(role));
    let mut result = ChannelResult::new(Channel::Residuals, hold_out.len());
    let Some(sums) = Sums::new(context, &select) else { return (result, None) };
    let frames: Vec<&LinearFrame> = select.iter().map(|&f| &sums.whole[f]).collect();
    let gains = cross_gains(&frames, &context.blocks(&select), &[0], &[0.0]);
    let chosen = sums.fit(context, &select);
    let demands = first_demands();
    let (total, z) = total_and_z(&gains);
    let large = chosen.theta[0].abs() > WALK_M;
    let enough = total > demands.nats && z > demands.z;
    let [by_octant, expected] = sums.by_octant(&chosen, &select);
    let alike = directions_agree(&by_octant, &expected);
    let outcome = match (enough, large, alike) {
        (true, true, true) => "chosen",
        (false, ..) => "no gain on frames that it was not fitted on",
        (_, false, _) => "too small to speak of",
        (.., false) => "surfaces in other directions say otherwise",
    };
    let cause = Cause::ReflectivityWalk;
    result.consider(cause, (total, z), context.returns(&select), outcome);
    let least = Minimum::new(Quantity::WalkM, (Z_STAR * sums.error_m(&chosen, &select)).max(WALK_M));
    result.minimum.push((cause, least));
    let fitted = sums.fit(context, &estimate);
    if outcome != "chosen" || fitted.theta[0].abs() < WALK_M {
        return (result, None);
    }
    let walk = Walk { brightness: sums.brightness, by_m: fitted.theta[0] };
    let gains: Vec<f64> = hold_out.iter().map(|&f| fitted.gain(&sums.whole[f])).collect();
    result.distance = gains.iter().map(|g| [g.max(0.0), *g, *g]).collect();
    let error_m = sums.error_m(&fitted, &estimate);
    result.found.push(found(context, &walk, error_m, gains, &estimate));
    (result, Some(walk))
}

/// The finding. The effect is of the simulated intensities.
fn found(context: &Context, walk: &Walk, error_m: f64, held_out_gains: Vec<f64>, estimate: &[usize]) -> Found {
    let by_m = walk.by_m;
    let way = if by_m < 0.0 { "shorter" } else { "longer" };
    Found {
        status: Status::Named,
        causes: vec![Cause::ReflectivityWalk],
        parameters: vec![parameter(Quantity::WalkM, by_m, error_m)],
        confidence: 1.0,
        channel: Channel::Residuals,
        covariate: Covariate::Brightness,
        held_out_gains,
        says: format!(
            "ranges depend on brightness: on a surface {:.1} times as bright they are {:.1} cm {way}",
            std::f64::consts::E,
            by_m.abs() * 100.0
        ),
        separate_by: None,
        curve: curve(context, walk, estimate),
        effects: vec![Effect::ReflectivityWalk(walk.brightness.simulated.effect(by_m))],
    }
}

/// Mean residual over brightness.
fn curve(context: &Context, walk: &Walk, estimate: &[usize]) -> Curve {
    let mut bins = std::collections::BTreeMap::<i32, [f64; 4]>::new();
    for ray in estimate.iter().flat_map(|&f| &context.frames[f].measured).filter(|r| usable(r)) {
        let off_m = f64::from(ray.residual_m);
        if let Some(bright) = walk.brightness.ln(ray).filter(|_| ray.cos_incidence > 0.2 && off_m.abs() < 0.3) {
            let sums = bins.entry((bright / BIN_LN).floor() as i32).or_default();
            [1.0, bright, off_m, off_m * off_m].iter().zip(sums).for_each(|(v, sum)| *sum += v);
        }
    }
    let point = |[n, x, y, yy]: [f64; 4]| CurvePoint {
        sensor: 0,
        x: x / n,
        measured: y / n,
        before: 0.0,
        after: walk.by_m * x / n,
        error: ((yy / n - (y / n).powi(2)).max(0.0) / n).sqrt(),
    };
    Curve {
        x: "brightness over the mean, ln".into(),
        y: "measured minus simulated range, m".into(),
        by_sensor: false,
        points: bins.into_values().filter(|s| s[0] >= FEWEST).map(point).collect(),
    }
}
