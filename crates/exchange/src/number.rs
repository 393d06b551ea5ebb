//! Numbers in files: short decimals without an exponent.

/// A number with at most nine decimals, without trailing zeros.
pub(crate) fn number(value: f64) -> String {
    let text = format!("{value:.9}");
    let short = text.trim_end_matches('0').trim_end_matches('.');
    if short == "-0" { "0".into() } else { short.into() }
}

/// Numbers in the form of [`number`], separated.
pub(crate) fn numbers(values: &[f64], separator: &str) -> String {
    values.iter().map(|v| number(*v)).collect::<Vec<_>>().join(separator)
}

/// A number rounded as in [`number`], for JSON.
pub(crate) fn rounded(value: f64) -> f64 {
    number(value).parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        for (value, want) in [(0.0, "0"), (-0.0, "0"), (0.02, "0.02"), (1.0, "1"), (-1e-12, "0"), (1e5, "100000")] {
            assert_eq!(number(value), want);
        }
        assert_eq!(numbers(&[0.5, -2.0], ", "), "0.5, -2");
        assert_eq!(rounded(1.0 / 3.0), 0.333333333);
    }
}
