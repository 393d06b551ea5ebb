//! Causes that the present diagnosis can name. This list decides which hidden effects count as nameable.

/// Names of `diagnose::Cause`, without `unexplained`, in alphabetical order. A test in `tests/town` compares the two.
pub const CATALOGUE: [&str; 42] = [
    "angular_jitter",
    "beam_elevation_offset",
    "beam_intensity",
    "beam_range_offset",
    "blooming",
    "bright_target_dropout",
    "coordinate_rounding",
    "dirty_window",
    "dual_returns",
    "ego_attitude",
    "ego_occlusion",
    "fog",
    "ghosts",
    "ground_error",
    "heavy_tails",
    "incidence_dropout",
    "incidence_noise",
    "intensity_law",
    "label_offset",
    "material_dropout",
    "missing_object",
    "mixed_pixels",
    "near_cut",
    "outliers",
    "packet_loss",
    "pitch_roll",
    "quantisation",
    "rain",
    "random_dropout",
    "range_bias",
    "range_cut",
    "range_drift",
    "range_dropout",
    "range_noise",
    "reflectivity_walk",
    "rolling_shutter",
    "sensor_extrinsics",
    "signal_dropout",
    "signal_noise",
    "spray",
    "time_offset",
    "wrong_shape",
];

/// Whether the present diagnosis can name a cause.
pub fn in_catalogue(cause: &str) -> bool {
    CATALOGUE.binary_search(&cause).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_list_is_sorted() {
        assert!(CATALOGUE.is_sorted() && in_catalogue("wrong_shape") && !in_catalogue("encoder_ripple"));
    }
}
