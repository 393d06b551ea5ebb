//! Signal index: the logarithm of the returned light relative to a reference; and the reflectivity that is assumed
//! where none is known.
//!
//! The index is `ln(reflectivity * cos(incidence) / R^2) - ln(0.1 / 250^2)`, R the range, m. It is 0 at the maximum
//! range of a typical data sheet, 250 m at a reflectivity of 10 %, and larger where more light returns.

/// Reflectivity at which the index is 0 at [`REFERENCE_RANGE_M`].
pub const REFERENCE_REFLECTIVITY: f64 = 0.1;
/// Range at which the index of a surface of [`REFERENCE_REFLECTIVITY`] at normal incidence is 0, m.
pub const REFERENCE_RANGE_M: f64 = 250.0;

/// Reflectivity that the diagnosis assumes for every surface. It equals the reference, so that the index depends on
/// range and incidence only.
pub const DIAGNOSIS_REFLECTIVITY: f64 = REFERENCE_REFLECTIVITY;
/// Signal index of a surface by reflectivity, cosine of incidence and range (m).
pub fn signal_index(reflectivity: f64, cos_incidence: f64, range_m: f64) -> f64 {
    (reflectivity / REFERENCE_REFLECTIVITY).ln() + cos_incidence.ln() + 2.0 * (REFERENCE_RANGE_M / range_m).ln()
}

/// Difference between [`signal_index`] and `ln(cos) - 2 ln(R)` at the reference reflectivity.
pub fn index_offset() -> f64 {
    2.0 * REFERENCE_RANGE_M.ln()
}

/// Signal index of an echo by its returned light (reflectivity times the incidence term), in f32 as in simulated scans.
pub fn returned_light_index(returned: f32, range_m: f32) -> f32 {
    let (reflectivity, reach_m) = (REFERENCE_REFLECTIVITY as f32, REFERENCE_RANGE_M as f32);
    (returned.max(1e-9) / (range_m * range_m)).ln() - (reflectivity / (reach_m * reach_m)).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_forms_agree() {
        assert_eq!(signal_index(0.1, 1.0, 250.0), 0.0);
        for (reflectivity, cos, range_m) in [(0.1, 1.0, 20.0), (0.5, 0.3, 80.0), (0.02, 0.9, 260.0)] {
            let index = signal_index(reflectivity, cos, range_m);
            let of_light = returned_light_index((reflectivity * cos) as f32, range_m as f32);
            assert!((f64::from(of_light) - index).abs() < 1e-4, "{of_light} {index}");
            let of_law = cos.ln() - 2.0 * range_m.ln() + index_offset();
            assert!((of_law - signal_index(REFERENCE_REFLECTIVITY, cos, range_m)).abs() < 1e-12);
        }
    }

    #[test]
    fn the_reference_reflectivity_changes_no_bit() {
        for i in 1..2000 {
            let (cos, range_m) = (f64::from(i) / 2000.0, f64::from(i) * 0.13);
            let without = cos.ln() + 2.0 * (250.0 / range_m).ln();
            assert_eq!(signal_index(DIAGNOSIS_REFLECTIVITY, cos, range_m).to_bits(), without.to_bits());
        }
    }
}
