//! Lookup tables with linear interpolation.

use data::KeyError;
use data::toml_text::{within, wrong};

/// Linear interpolation of the points (`at`, `values`) at `x`, constant beyond both ends. The table must have been
/// checked.
pub fn interpolated(at: &[f64], values: &[f64], x: f64) -> f64 {
    let after = at.partition_point(|a| *a <= x);
    if after == 0 || after == at.len() {
        return values[after.min(values.len() - 1)];
    }
    let t = (x - at[after - 1]) / (at[after] - at[after - 1]);
    values[after - 1] + t * (values[after] - values[after - 1])
}

/// A column of a table: key, values, and the limits of the values.
pub(super) type Column<'a> = (&'a str, &'a [f64], [f64; 2]);

/// Checks that both columns have the same length, at least 1, that values are within limits, and that `at` is strictly
/// ascending.
pub(super) fn check_table(at: Column, values: Column) -> Result<(), KeyError> {
    if at.1.is_empty() || at.1.len() != values.1.len() {
        let (places, numbers) = (at.1.len(), values.1.len());
        return Err(wrong(
            values.0,
            format!(
                "{places} values of {} and {numbers} of {}: a table needs as many of each, at least 1",
                at.0, values.0
            ),
        ));
    }
    for (name, numbers, [low, high]) in [values, at] {
        numbers.iter().enumerate().try_for_each(|(i, v)| within(&format!("{name}[{i}]"), *v, low, high))?;
    }
    match at.1.windows(2).position(|w| w[0] >= w[1]) {
        Some(i) => Err(wrong(format!("{}[{}]", at.0, i + 1), "is not larger than the previous value")),
        None => Ok(()),
    }
}
