//! Axes with round tick values.

/// One axis: its value range, and the pixel positions of its ends.
pub(crate) struct Axis {
    pub low: f64,
    pub high: f64,
    px: [f64; 2],
    /// Tick spacing.
    step: f64,
    /// Logarithmic axis: values are exponents of ten.
    log: bool,
}

impl Axis {
    /// An axis that covers all values; its ends are rounded to ticks.
    pub fn new(values: impl Iterator<Item = f64>, px: [f64; 2], log: bool) -> Axis {
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
        let (low, high) = match (low, high) {
            (low, high) if low > high => (0.0, 1.0),
            (low, high) if low == high => (low - 0.5, high + 0.5),
            ends => ends,
        };
        let rough = (high - low) / 6.0;
        let power = 10f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|k| k * power).find(|s| *s >= rough * 0.999).unwrap_or(power);
        let step = if log { step.max(1.0).round() } else { step };
        let vertical = px[0] > px[1];
        let (low, high) =
            if vertical { ((low / step).floor() * step, (high / step).ceil() * step) } else { (low, high) };
        Axis { low, high, px, step, log }
    }

    pub fn px(&self, value: f64) -> f64 {
        self.px[0] + (value - self.low) / (self.high - self.low) * (self.px[1] - self.px[0])
    }

    /// Value and label of each tick.
    pub fn ticks(&self) -> Vec<(f64, String)> {
        let (first, last) =
            ((self.low / self.step - 1e-9).ceil() as i64, (self.high / self.step + 1e-9).floor() as i64);
        let digits = (-self.step.log10().floor()).clamp(0.0, 12.0) as usize;
        let name = |value: f64| match (self.log, value.abs()) {
            (true, _) if value.abs() < 5.0 => format!("{}", 10f64.powi(value as i32)),
            (true, _) => format!("1e{value:.0}"),
            (false, size) if size >= 1e5 => format!("{value:.1e}"),
            _ => format!("{value:.digits$}"),
        };
        (first..=last).map(|i| i as f64 * self.step).map(|value| (value, name(value))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tick_names(values: [f64; 2], log: bool) -> Vec<String> {
        let values = values.map(|v| if log { v.log10() } else { v });
        Axis::new(values.into_iter(), [100.0, 0.0], log).ticks().into_iter().map(|(_, name)| name).collect()
    }

    #[test]
    fn ticks_are_round_numbers_around_all_values() {
        assert_eq!(tick_names([0.0, 1.0], false), ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]);
        assert_eq!(tick_names([0.0, 4000.0], false), ["0", "1000", "2000", "3000", "4000"]);
        assert_eq!(tick_names([3.0, 3.0], false).len(), 7);
        assert_eq!(tick_names([0.02, 7.0], true), ["0.01", "0.1", "1", "10"]);
    }
}
