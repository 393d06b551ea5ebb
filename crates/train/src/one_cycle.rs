//! The one-cycle schedule of learning rate and momentum (Smith 2018), as in fastai and OpenPCDet.

use models::config::OptimizationConfig;
use std::f64::consts::PI;

/// Learning rate and `beta1` of every iteration of a run.
///
/// Both follow half cosines. Over the first `pct_start` of the iterations the rate rises from `lr_max / div_factor` to
/// `lr_max` and the momentum falls from `momentum[0]` to `momentum[1]`. Over the rest the rate falls to `lr_max /
/// div_factor / 1e4` and the momentum rises back to `momentum[0]`. The values are set before an iteration, so iteration
/// 0 runs at `lr_max / div_factor`.
#[derive(Clone, Debug, PartialEq)]
pub struct OneCycle {
    total_steps: u64,
    rise_steps: u64,
    lr: [f64; 3],
    momentum: [f64; 2],
}

impl OneCycle {
    /// The cycle of a run of `total_steps` iterations.
    pub fn new(config: &OptimizationConfig, total_steps: u64) -> Self {
        let low = config.lr_max / config.div_factor;
        OneCycle {
            total_steps,
            rise_steps: (config.pct_start * total_steps as f64) as u64,
            lr: [low, config.lr_max, low / 1e4],
            momentum: config.momentum,
        }
    }

    /// `(learning rate, beta1)` of iteration `step`, counted from 0.
    pub fn at(&self, step: u64) -> (f64, f64) {
        let ([low, peak, last], [calm, eager]) = (self.lr, self.momentum);
        if step < self.rise_steps {
            let share = step as f64 / self.rise_steps as f64;
            return (half_cosine(low, peak, share), half_cosine(calm, eager, share));
        }
        let share = (step - self.rise_steps) as f64 / (self.total_steps - self.rise_steps).max(1) as f64;
        (half_cosine(peak, last, share), half_cosine(eager, calm, share))
    }
}

/// Half-cosine interpolation from `start` at share 0 to `end` at share 1.
fn half_cosine(start: f64, end: f64, share: f64) -> f64 {
    end + (start - end) / 2.0 * ((PI * share).cos() + 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use safetensors::SafeTensors;

    #[test]
    fn equals_the_reference_at_every_iteration() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/operators/one_cycle.safetensors");
        let bytes = std::fs::read(path).unwrap();
        let golden = SafeTensors::deserialize(&bytes).unwrap();
        let column = |name: &str| -> Vec<f64> {
            let data = golden.tensor(name).unwrap().data();
            data.chunks_exact(8).map(|b| f64::from_le_bytes(b.try_into().unwrap())).collect()
        };
        for lr_max in [0.003, 0.01] {
            let (lr, beta1) = (column(&format!("lr_max_{lr_max}.lr")), column(&format!("lr_max_{lr_max}.beta1")));
            let schedule = OneCycle::new(&OptimizationConfig { lr_max, ..Default::default() }, lr.len() as u64);
            for step in 0..lr.len() {
                let (got_lr, got_beta1) = schedule.at(step as u64);
                assert!((got_lr / lr[step] - 1.0).abs() < 1e-12, "lr of step {step}: {got_lr} instead of {}", lr[step]);
                assert!(
                    (got_beta1 - beta1[step]).abs() < 1e-14,
                    "beta1 of step {step}: {got_beta1} instead of {}",
                    beta1[step]
                );
            }
        }
    }

    #[test]
    fn a_run_of_one_step_has_a_rate() {
        let (lr, beta1) = OneCycle::new(&OptimizationConfig::default(), 1).at(0);
        assert!(lr == 0.003 && beta1 == 0.85, "{lr} {beta1}");
    }
}
