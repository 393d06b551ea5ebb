//! What a sensor makes of a surface: whether it returns, with which mean range, and with which scatter.

use crate::effect::{Dark, Effect, Spot};
use crate::frame::{Echo, Frame};
use crate::sensor::Shot;
use crate::side::normal;
use crate::solid::Material;
use crate::world::{Object, REACH_M};
use data::Stream;
use rand::RngExt;
use std::f64::consts::{LN_2, TAU};

/// Standard deviations of the parts of the range noise of a return, m.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Scatter {
    /// Logistic.
    pub logistic_m: f64,
    /// A mixture of two normal distributions.
    pub mixture_m: f64,
    /// Laplace.
    pub laplace_m: f64,
    /// Triangular.
    pub triangle_m: f64,
    /// Normal.
    pub normal_m: f64,
    /// Probability and standard deviation of a Laplace distributed tail.
    pub tail: [f64; 2],
    /// Mean of an exponentially distributed depth.
    pub depth_m: f64,
}

/// `erf`, with an error below 2e-7 (Abramowitz and Stegun 7.1.26 has 1.5e-7).
pub fn erf(x: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.327_591_1 * x.abs());
    let poly =
        t * (0.254_829_592 + t * (-0.284_496_736 + t * (1.421_413_741 + t * (-1.453_152_027 + t * 1.061_405_429))));
    x.signum() * (1.0 - poly * (-x * x).exp())
}

/// Signal at the point of a data sheet, 10 % at 250 m: the zero of the signal index of the diagnosis.
fn data_sheet_signal() -> f64 {
    (0.1f64 / (250.0 * 250.0)).ln()
}

impl Scatter {
    /// Variance, m2.
    pub fn variance_m2(&self) -> f64 {
        let parts = [self.logistic_m, self.mixture_m, self.laplace_m, self.triangle_m, self.normal_m, self.depth_m];
        parts.iter().map(|s| s * s).sum::<f64>() + self.tail[0] * self.tail[1] * self.tail[1]
    }

    /// A random error, m.
    pub fn draw(&self, rng: &mut Stream) -> f64 {
        let mut sum = 0.0;
        if self.logistic_m > 0.0 {
            let u: f64 = rng.random_range(1e-9..1.0 - 1e-9);
            // The standard logistic distribution has a variance of pi^2 / 3.
            sum += self.logistic_m * (u / (1.0 - u)).ln() * 3f64.sqrt() / std::f64::consts::PI;
        }
        if self.mixture_m > 0.0 {
            // 0.7 of standard deviation a and 0.3 of 1.7 a: 0.7 + 0.3 * 2.89 = 1.567.
            let wide = if rng.random_bool(0.3) { 1.7 } else { 1.0 };
            sum += self.mixture_m * wide / 1.567f64.sqrt() * normal(rng);
        }
        if self.laplace_m > 0.0 {
            sum += self.laplace_m * laplace(rng);
        }
        if self.triangle_m > 0.0 {
            sum += self.triangle_m * triangular(rng);
        }
        if self.normal_m > 0.0 {
            sum += self.normal_m * normal(rng);
        }
        if self.tail[0] > 0.0 && rng.random::<f64>() < self.tail[0] {
            sum += self.tail[1] * laplace(rng);
        }
        if self.depth_m > 0.0 {
            sum -= self.depth_m * rng.random_range(1e-9f64..1.0).ln();
        }
        sum
    }
}

/// A Laplace distributed random number with variance 1.
fn laplace(rng: &mut Stream) -> f64 {
    let size = -rng.random_range(1e-9f64..1.0).ln() / 2f64.sqrt();
    if rng.random_bool(0.5) { size } else { -size }
}

/// A triangularly distributed random number with variance 1.
pub fn triangular(rng: &mut Stream) -> f64 {
    (rng.random::<f64>() + rng.random::<f64>() - 1.0) * 6f64.sqrt()
}

impl Spot {
    /// Share of the effect at a direction: 1 at the centre, one half at the radius.
    pub fn share(&self, shot: &Shot) -> f64 {
        if shot.sensor != self.sensor {
            return 0.0;
        }
        let away = [shot.azimuth_rad - self.center[0], shot.elevation_rad - self.center[1]];
        let square = (away[0] / self.radius[0]).powi(2) + (away[1] / self.radius[1]).powi(2);
        (-LN_2 * square.powf(1.5)).exp()
    }
}

/// What a range walk changes the range of a surface by, m.
pub fn walk_of_m(walk_m: f64, reflectivity: f64) -> f64 {
    -walk_m * (0.8 * (reflectivity / 0.25).ln()).tanh()
}

impl Frame<'_> {
    /// Attenuation of the way to a range and back, in the logarithm of the signal.
    pub fn attenuation(&self, range_m: f64) -> f64 {
        let per_m = |effect: &Effect| match *effect {
            Effect::Fog { visibility_m, .. } => 3.0 / visibility_m,
            Effect::Rain { per_m, .. } => per_m,
            _ => 0.0,
        };
        2.0 * range_m * self.side.effects.iter().map(per_m).sum::<f64>()
    }

    /// Probability that a surface with a signal returns without any effect.
    pub fn usually_kept(&self, signal: f64) -> f64 {
        let (usual, [_, ln_lost, threshold, ..]) = (&self.side.nuisances, self.unsteady());
        let seen = 0.5 * (1.0 + (4.0 * (signal - usual.weakest - threshold)).tanh());
        (1.0 - usual.lost * ln_lost.exp()) * seen
    }

    /// Probability that a surface returns.
    pub fn kept(&self, shot: &Shot, echo: &Echo) -> f64 {
        let side = self.side;
        if self.lost[shot.sensor][shot.column / crate::frame::PACKET] {
            return 0.0;
        }
        let signal = echo.signal() - self.attenuation(echo.range_m);
        let mut kept = self.usually_kept(signal);
        for effect in &side.effects {
            kept *= match *effect {
                Effect::RandomDropout { share } => 1.0 - (share * self.loss_factor).min(0.98),
                Effect::SignalDropout { half_at, steepness } => {
                    // Gompertz: one half where the inner exponential is ln 2.
                    (-LN_2 * (-steepness * (signal - half_at)).exp()).exp()
                }
                Effect::RangeDropout { half_at_m, softness_m } => {
                    0.5 * (1.0 - erf((echo.range_m - half_at_m) / (2f64.sqrt() * softness_m)))
                }
                Effect::IncidenceDropout { cos_half, power } if !echo.material.is_retroreflective() => {
                    erf(0.476_936_3 * (echo.cos_incidence / cos_half).powf(power))
                }
                Effect::MaterialDropout { dark, share } => {
                    let of_vehicle = matches!(echo.object, Object::Vehicle(_));
                    let is_dark = match dark {
                        Dark::Tyres => echo.material == Material::Rubber,
                        Dark::Bodies => of_vehicle && matches!(echo.material, Material::Paint | Material::Glass),
                    };
                    if is_dark { 1.0 - share } else { 1.0 }
                }
                Effect::RangeCut { max_m } => 0.5 * (1.0 - erf((echo.range_m - max_m) / 0.1)),
                Effect::RangeLimits { min_m } => 0.5 * (1.0 + erf((echo.range_m - min_m) / 0.1)),
                Effect::DirtyWindow { spot, share, .. } => 1.0 - share * spot.share(shot),
                Effect::BrightTargetDropout { share, halo_rad } => {
                    let near = |angle: f64, half: f64| (-((angle - half).max(0.0) / halo_rad).powi(2)).exp();
                    let bright = self.bright[shot.sensor].iter().filter(|b| (b.range_m - echo.range_m).abs() > 0.5);
                    let most = bright.map(|b| near(self.away(shot, &b.direction), b.half_rad)).fold(0.0, f64::max);
                    1.0 - share * most
                }
                Effect::Bursts { .. } if self.in_burst(shot) => 0.75,
                Effect::ColumnLoss { share, every } if shot.column.is_multiple_of(every) => 1.0 - share,
                _ => 1.0,
            };
        }
        kept
    }

    /// Angle between a shot and a direction of its sensor's frame, rad.
    pub fn away(&self, shot: &Shot, direction: &nalgebra::Vector3<f64>) -> f64 {
        crate::sensor::direction(shot.azimuth_rad, shot.elevation_rad).dot(direction).clamp(-1.0, 1.0).acos()
    }

    fn in_burst(&self, shot: &Shot) -> bool {
        self.burst
            .is_some_and(|(sensor, middle, half)| shot.sensor == sensor && (shot.azimuth_rad - middle).abs() < half)
    }

    /// Mean of the reported range minus the true one, m.
    pub fn shift_m(&self, shot: &Shot, echo: &Echo) -> f64 {
        let side = self.side;
        let range = echo.range_m;
        let mut shift = side.rows[shot.sensor][shot.row].offset_m + self.unsteady()[3];
        let aged = (1.0 - (-2.5 * self.time_s / side.duration_s.max(1e-9)).exp()) / (1.0 - (-2.5f64).exp());
        for effect in &side.effects {
            shift += match *effect {
                Effect::RangeBias { offset_m, scale } => offset_m + scale * range * (1.0 + 0.05 * range / REACH_M),
                Effect::ReflectivityWalk { walk_m } => walk_of_m(walk_m, echo.reflectivity),
                Effect::RangeDrift { drift_m } => drift_m * aged,
                Effect::ThermalRows { drift_m } => drift_m * aged * if shot.row.is_multiple_of(2) { 1.0 } else { -1.0 },
                Effect::RangeRipple { amplitude_m, length_m } => amplitude_m * (TAU * range / length_m).sin(),
                _ => 0.0,
            };
        }
        shift
    }

    /// Scatter of the reported range.
    pub fn scatter(&self, shot: &Shot, echo: &Echo) -> Scatter {
        let side = self.side;
        let mut scatter =
            Scatter { logistic_m: side.nuisances.noise_m * self.unsteady()[0].exp(), ..Scatter::default() };
        if echo.material == Material::Leaves {
            scatter.depth_m = side.nuisances.leaves_m;
        }
        for effect in &side.effects {
            match *effect {
                Effect::RangeNoise { std_m, growth } => scatter.mixture_m = std_m.hypot(growth * echo.range_m),
                Effect::SignalNoise { std_m, growth } => {
                    let u = echo.signal() - self.attenuation(echo.range_m) - data_sheet_signal();
                    scatter.laplace_m = std_m * (1.0 + (growth * (4.0 - u)).exp()).ln() / LN_2;
                }
                Effect::IncidenceNoise { angle_rad } => {
                    let tan = (1.0 / echo.cos_incidence.max(0.05).powi(2) - 1.0).max(0.0).sqrt();
                    scatter.triangle_m = (angle_rad * echo.range_m * tan).min(0.5);
                }
                Effect::HeavyTails { share, std_m } => scatter.tail = [share, std_m],
                Effect::DirtyWindow { spot, noise_m, .. } => {
                    scatter.normal_m = scatter.normal_m.hypot(noise_m * spot.share(shot));
                }
                Effect::Bursts { std_m, .. } if self.in_burst(shot) => {
                    scatter.normal_m = scatter.normal_m.hypot(std_m);
                }
                _ => {}
            }
        }
        scatter
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn erf_has_its_known_values() {
        for (x, value) in [(0.0, 0.0), (0.5, 0.520_499_878), (1.0, 0.842_700_793), (-2.0, -0.995_322_265)] {
            assert!((erf(x) - value).abs() < 2e-7, "{x}");
        }
        assert!((erf(0.476_936_3) - 0.5).abs() < 2e-7);
    }

    #[test]
    fn scatter_has_the_variance_that_it_says() {
        let mut rng = data::stream(1, "scatter", 0, 0);
        let one = 0.03;
        for scatter in [
            Scatter { logistic_m: one, ..Scatter::default() },
            Scatter { mixture_m: one, ..Scatter::default() },
            Scatter { laplace_m: one, ..Scatter::default() },
            Scatter { triangle_m: one, ..Scatter::default() },
            Scatter { normal_m: one, ..Scatter::default() },
            Scatter { tail: [0.1, 0.3], ..Scatter::default() },
            Scatter { depth_m: one, ..Scatter::default() },
        ] {
            let drawn: Vec<f64> = (0..60_000).map(|_| scatter.draw(&mut rng)).collect();
            let mean = drawn.iter().sum::<f64>() / drawn.len() as f64;
            let variance = drawn.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / drawn.len() as f64;
            assert!((variance / scatter.variance_m2() - 1.0).abs() < 0.08, "{scatter:?}: {variance}");
            assert!((mean - scatter.depth_m).abs() < 2e-3);
        }
    }
}
