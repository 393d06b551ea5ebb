//! Losses that depend on range alone.

use sensor::effects::{Covariate, Effect, SignalDropout, interpolated};
use sensor::signal::{REFERENCE_REFLECTIVITY, signal_index};

/// The share of returns that is lost, as a function of range: the product of what each effect keeps.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct RangeLoss {
    parts: Vec<Effect>,
}

impl RangeLoss {
    /// Adds an effect. Returns false if its losses do not depend on range, which changes nothing.
    ///
    /// Of `signal_dropout`, the part that depends on range is taken: at normal incidence, and at the reflectivity of
    /// standing surfaces that the effect assumes, or at 10 % without one.
    pub fn add(&mut self, effect: &Effect) -> bool {
        let of_range = match effect {
            Effect::RandomDropout(_) | Effect::RangeDropout(_) | Effect::SignalDropout(_) => true,
            Effect::Empirical(e) => e.sensor.is_empty() && e.covariate == Covariate::RangeM && !e.loss.is_empty(),
            _ => false,
        };
        if of_range {
            self.parts.push(effect.clone());
        }
        of_range
    }

    /// Whether there is no loss.
    pub fn is_empty(&self) -> bool {
        self.parts.is_empty()
    }

    /// Share that is lost at a range, 0 to 1.
    pub fn at(&self, range_m: f64) -> f64 {
        1.0 - self.parts.iter().map(|effect| kept(effect, range_m).clamp(0.0, 1.0)).product::<f64>()
    }
}

fn kept(effect: &Effect, range_m: f64) -> f64 {
    match effect {
        Effect::RandomDropout(e) => 1.0 - e.share,
        Effect::RangeDropout(e) if !e.range_m.is_empty() => 1.0 - interpolated(&e.range_m, &e.share, range_m),
        Effect::Empirical(e) => 1.0 - interpolated(&e.at, &e.loss, range_m),
        Effect::SignalDropout(e) => detected(e, range_m),
        _ => 1.0,
    }
}

/// Probability of detection by `signal_dropout` at normal incidence.
fn detected(e: &SignalDropout, range_m: f64) -> f64 {
    let reflectivity = e.assumed.map_or(REFERENCE_REFLECTIVITY, |assumed| assumed.standing);
    let signal = signal_index(reflectivity, 1.0, range_m) - 2.0 * e.attenuation_per_m * range_m;
    let middle = e.threshold + (0.5f64.powf(-1.0 / e.skew) - 1.0).ln() / e.steepness;
    let form = e.form.as_ref().map_or(1.0, |form| interpolated(&form.at, &form.factor, signal));
    form * e.most * (1.0 + (-e.steepness * (signal - middle)).exp()).powf(-e.skew)
}

#[cfg(test)]
mod tests {
    use super::*;
    use sensor::effects::{RandomDropout, RangeDropout, RangeNoise};

    #[test]
    fn shares_that_are_kept_multiply() {
        let mut loss = RangeLoss::default();
        assert!(loss.is_empty() && loss.at(50.0) == 0.0);
        assert!(!loss.add(&Effect::RangeNoise(RangeNoise { std_m: 0.1 })));
        assert!(loss.add(&Effect::RandomDropout(RandomDropout { share: 0.2 })));
        let table = RangeDropout { range_m: vec![0.0, 100.0], share: vec![0.0, 0.5] };
        assert!(loss.add(&Effect::RangeDropout(table)));
        for (range_m, want) in [(0.0, 0.2), (50.0, 0.4), (100.0, 0.6), (200.0, 0.6)] {
            assert!((loss.at(range_m) - want).abs() < 1e-12, "{range_m}");
        }
    }

    #[test]
    fn detection_by_light_is_half_at_its_threshold() {
        let mut loss = RangeLoss::default();
        let law = SignalDropout {
            most: 0.9,
            threshold: 0.0,
            steepness: 4.0,
            skew: 0.5,
            attenuation_per_m: 0.0,
            assumed: None,
            form: None,
            estimated_incidence: None,
        };
        loss.add(&Effect::SignalDropout(law));
        assert!((loss.at(250.0) - 0.55).abs() < 1e-9, "{}", loss.at(250.0));
        assert!(loss.at(10.0) < 0.1001 && loss.at(1000.0) > 0.9);
    }
}
