//! Tables: values at ascending places, and what lies between them.

use data::KeyError;
use data::toml_text::{within, wrong};

/// The value at `x` on the lines through the points (`at`, `values`); beyond both ends that of the end. The table must have been checked.
pub(super) fn interpolated(at: &[f64], values: &[f64], x: f64) -> f64 {
    let after = at.partition_point(|a| *a <= x);
    if after == 0 || after == at.len() {
        return values[after.min(values.len() - 1)];
    }
    let t = (x - at[after - 1]) / (at[after] - at[after - 1]);
    values[after - 1] + t * (values[after] - values[after - 1])
}

/// A column of a table: the key, its numbers, and between what they must lie.
pub(super) type Column<'a> = (&'a str, &'a [f64], [f64; 2]);

/// Refuses what is no table: places that do not ascend, another number of values, numbers out of bounds.
pub(super) fn check_table(at: Column, values: Column) -> Result<(), KeyError> {
    if at.1.is_empty() || at.1.len() != values.1.len() {
        let (places, numbers) = (at.1.len(), values.1.len());
        return Err(wrong(
            values.0,
            format!("{places} numbers of {} and {numbers} of {} make no table", at.0, values.0),
        ));
    }
    for (name, numbers, [low, high]) in [values, at] {
        numbers.iter().enumerate().try_for_each(|(i, v)| within(&format!("{name}[{i}]"), *v, low, high))?;
    }
    match at.1.windows(2).position(|w| w[0] >= w[1]) {
        Some(i) => Err(wrong(format!("{}[{}]", at.0, i + 1), "is not larger than the one before")),
        None => Ok(()),
    }
}
