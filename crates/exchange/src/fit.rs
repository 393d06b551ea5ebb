//! CARLA's drop-off, fitted to a law of loss by range.
//!
//! Source: `RayCastLidar.cpp` of CARLA 0.9 (`ComputeDetection`, `PreprocessRays`, `PostprocessDetection`). A ray is not
//! cast with probability g (`dropoff_general_rate`). The intensity of a return at range R is `I = exp(-a R)`, a
//! `atmosphere_attenuation_rate`. A return with `I > L` (`dropoff_intensity_limit`) is kept, others are kept with
//! probability `(z / L) I + 1 - z`, z `dropoff_zero_intensity`.

/// Ranges over which the drop-off is fitted and compared, m.
pub const FIT_RANGES_M: [f64; 2] = [5.0, 100.0];

/// Number of ranges at which it is compared.
const RANGES: usize = 191;

/// Least and largest attenuation rate that are tried, 1/m.
const ATTENUATION_PER_M: [f64; 2] = [1e-4, 0.2];

/// Parameters of CARLA's drop-off.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DropOff {
    /// `atmosphere_attenuation_rate`, 1/m.
    pub attenuation_per_m: f64,
    /// `dropoff_general_rate`, 0 to 1.
    pub general: f64,
    /// `dropoff_intensity_limit`, 0 to 1.
    pub limit: f64,
    /// `dropoff_zero_intensity`, 0 to 1.
    pub zero: f64,
}

impl DropOff {
    /// No loss, with CARLA's usual attenuation.
    pub fn none() -> DropOff {
        DropOff { attenuation_per_m: 0.004, general: 0.0, limit: 0.8, zero: 0.0 }
    }

    /// Share of returns that is lost at a range: `g + (1 - g) z max(0, 1 - exp(-a R) / L)`.
    pub fn loss(&self, range_m: f64) -> f64 {
        let weak = (1.0 - (-self.attenuation_per_m * range_m).exp() / self.limit).max(0.0);
        self.general + (1.0 - self.general) * self.zero * weak
    }
}

/// The ranges at which laws are compared, m.
pub(crate) fn ranges() -> impl Iterator<Item = f64> {
    let [near, far] = FIT_RANGES_M;
    (0..RANGES).map(move |i| near + (far - near) * i as f64 / (RANGES - 1) as f64)
}

/// The drop-off that is closest to a law of loss by range in the square over [`FIT_RANGES_M`].
///
/// A law that does not depend on range gives its general rate exactly. For the others, attenuation and the range at
/// which the loss begins are searched on a grid that is refined twice; the other two parameters follow from them.
pub fn fit_drop_off(law: impl Fn(f64) -> f64) -> DropOff {
    let targets: Vec<(f64, f64)> = ranges().map(|range_m| (range_m, law(range_m))).collect();
    let (least, most) = targets.iter().fold((1.0f64, 0.0f64), |(l, m), (_, t)| (l.min(*t), m.max(*t)));
    if most - least < 1e-9 {
        return DropOff { general: least.clamp(0.0, 1.0), ..DropOff::none() };
    }
    let [low, high] = ATTENUATION_PER_M.map(f64::ln);
    let mut window = [[low, high], [0.0, FIT_RANGES_M[1]]];
    let mut best = (f64::INFINITY, DropOff::none());
    for _ in 0..4 {
        let mut at = [0.0; 2];
        const STEPS: usize = 60;
        for i in 0..=STEPS {
            for j in 0..=STEPS {
                let place = |w: [f64; 2], k: usize| w[0] + (w[1] - w[0]) * k as f64 / STEPS as f64;
                let (log_rate, begin_m) = (place(window[0], i), place(window[1], j));
                let (error, candidate) = with_shape(log_rate.exp(), begin_m, &targets);
                if error < best.0 {
                    best = (error, candidate);
                    at = [log_rate, begin_m];
                }
            }
        }
        if at == [0.0; 2] {
            break;
        }
        for (w, (center, [least, most])) in window.iter_mut().zip(at.into_iter().zip([[low, high], [0.0, 100.0]])) {
            let half = (w[1] - w[0]) / 12.0;
            *w = [(center - half).max(least), (center + half).min(most)];
        }
    }
    best.1
}

/// The best drop-off with this attenuation whose losses begin at a range, and the sum of its squared errors.
fn with_shape(rate: f64, begin_m: f64, targets: &[(f64, f64)]) -> (f64, DropOff) {
    let limit = (-rate * begin_m).exp();
    let weak = |range_m: f64| (1.0 - (-rate * range_m).exp() / limit).max(0.0);
    let (mut n, mut sx, mut sy, mut sxx, mut sxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (range_m, target) in targets {
        let x = weak(*range_m);
        n += 1.0;
        sx += x;
        sy += target;
        sxx += x * x;
        sxy += x * target;
    }
    let spread = sxx - sx * sx / n;
    let slope = if spread > 1e-12 { (sxy - sx * sy / n) / spread } else { 0.0 };
    let mut general = (sy - slope * sx) / n;
    let mut slope = slope.max(0.0);
    if !(0.0..=1.0).contains(&general) || slope == 0.0 {
        // At the border of what is allowed, the other parameter follows alone.
        if slope == 0.0 {
            general = sy / n;
        } else {
            general = general.clamp(0.0, 1.0);
            slope = ((sxy - general * sx) / sxx.max(1e-12)).max(0.0);
        }
    }
    slope = slope.min(1.0 - general);
    let zero = if general < 1.0 { slope / (1.0 - general) } else { 0.0 };
    let fitted = DropOff { attenuation_per_m: rate, general, limit, zero };
    let error = targets.iter().map(|(range_m, target)| (fitted.loss(*range_m) - target).powi(2)).sum();
    (error, fitted)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    /// Share of 200,000 returns at a range that CARLA loses: its code, in its precision, with other random numbers.
    fn emulated(drop_off: &DropOff, range_m: f64, seed: u64) -> f64 {
        let mut random = data::stream(seed, "carla", 0, (range_m * 1000.0) as u64);
        let [general, limit, zero, rate] =
            [drop_off.general, drop_off.limit, drop_off.zero, drop_off.attenuation_per_m].map(|v| v as f32);
        let (beta, alpha) = (1.0f32 - zero, zero / limit);
        let general_active = general > f32::EPSILON;
        const SHOTS: usize = 200_000;
        let kept = (0..SHOTS).filter(|_| {
            if general_active && random.random::<f32>() < general {
                return false;
            }
            let intensity = (-rate * range_m as f32).exp();
            intensity > limit || random.random::<f32>() < alpha * intensity + beta
        });
        1.0 - kept.count() as f64 / SHOTS as f64
    }

    #[test]
    fn emulated_drop_off_is_its_law_within_one_percentage_point() {
        type Law = Box<dyn Fn(f64) -> f64>;
        let table = |at: &'static [f64], share: &'static [f64]| -> Law {
            Box::new(move |r| sensor::effects::interpolated(at, share, r))
        };
        let laws: Vec<(&str, f64, Law)> = vec![
            ("constant", 1e-9, Box::new(|_| 0.2)),
            (
                "CARLA's default",
                0.002,
                Box::new(|r| DropOff { attenuation_per_m: 0.004, general: 0.45, limit: 0.8, zero: 0.4 }.loss(r)),
            ),
            ("linear", 0.01, table(&[0.0, 100.0], &[0.0, 0.3])),
            ("late", 0.05, table(&[0.0, 60.0, 100.0], &[0.05, 0.05, 0.6])),
            ("saturating", 0.01, Box::new(|r| 0.1 + 0.5 * (1.0 - (-r / 30.0f64).exp()))),
        ];
        for (name, most, law) in laws {
            let fitted = fit_drop_off(&law);
            for range_m in (5..=100).step_by(5).map(f64::from) {
                let emulated = emulated(&fitted, range_m, 7);
                let error = (emulated - fitted.loss(range_m)).abs();
                assert!(error < 0.01, "{name} at {range_m} m: emulated {emulated}, law {}", fitted.loss(range_m));
                let off = (fitted.loss(range_m) - law(range_m)).abs();
                assert!(off <= most, "{name} at {range_m} m: fitted {}, asked {}", fitted.loss(range_m), law(range_m));
            }
            for value in [fitted.general, fitted.zero, fitted.limit] {
                assert!((0.0..=1.0).contains(&value), "{name}: {fitted:?}");
            }
        }
    }

    #[test]
    fn a_loss_that_falls_with_range_becomes_its_mean() {
        let fitted = fit_drop_off(|r| 0.5 - r / 400.0);
        assert_eq!(fitted.zero, 0.0);
        assert!((fitted.general - (0.5 - 52.5 / 400.0)).abs() < 1e-6, "{fitted:?}");
    }
}
