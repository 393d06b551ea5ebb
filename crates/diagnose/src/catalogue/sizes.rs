//! How large an effect must be to be reported: one table for all searches.
//!
//! What is significant need not matter. With millions of returns a bias of half a millimetre is significant, while the
//! surfaces of the simulation lie two centimetres beside the real ones. Each size has its reason; searches raise it
//! where the frames at hand leave more in doubt.

/// An entry of the table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Size {
    /// Name of the constant.
    pub name: &'static str,
    /// The smallest size that is reported.
    pub least: f64,
    /// Its unit: `m`, `rad`, `degrees`, `s`, `share` of what is named, or `ln` of an intensity.
    pub unit: &'static str,
    /// What is that large.
    pub what: &'static str,
    /// Why no smaller one is reported.
    pub why: &'static str,
}

macro_rules! sizes {
    ($($name:ident = $least:literal $unit:literal: $what:literal, $why:literal;)*) => {
        $(#[doc = concat!($what, ": ", $why, ".")]
        pub const $name: f64 = $least;)*

        /// All sizes, by channel.
        pub const SIZES: &[Size] =
            &[$(Size { name: stringify!($name), least: $least, unit: $unit, what: $what, why: $why },)*];
    };
}

sizes! {
    // Where surfaces lie.
    DISPLACED_M = 0.004 "m": "displacement of surfaces, root mean square, beyond what errors of the surfaces can be",
        "surfaces of a model lie beside the real ones in all frames alike, and more frames do not tell that from less";
    RANGE_OFFSET_M = 0.012 "m": "range bias or drift at 10 m", "less is below the range noise of most sensors";
    FAR_RANGE_OFFSET_M = 0.0384 "m": "range bias or drift at 40 m", "a thousandth of the range, as at 10 m";
    TURN_RAD = 5.2e-4 "rad": "turn of the scene", "0.03 degrees are 2.6 cm at 50 m, less than labels are placed by";
    SHIFT_M = 0.04 "m": "shift of the scene", "labels are placed no better";
    SWEEP_M = 0.08 "m": "displacement over a scan", "it shifts the scene by half of it at either end";
    SWEEP_RAD = 0.01 "rad": "turn over a scan", "half of it at either end is 5 cm at 10 m";
    ROWS_RANGE_M = 0.006 "m": "spread of the range offsets of rows", "data sheets state a few millimetres";
    ROWS_ELEVATION_RAD = 2.6e-4 "rad": "spread of the elevation offsets of rows", "half of the smallest turn";
    STRIPS_RANGE_M = 0.02 "m": "spread of range offsets over azimuth", "surfaces of a model are off by as much";
    STEPS_RANGE_M = 0.012 "m": "spread of range offsets over range", "that of a range bias";
    WALK_M = 0.003 "m": "range by the logarithm of brightness", "less is below the step of most sensors";

    // Noise.
    NOISE_M = 0.003 "m": "standard deviation along the ray", "less is below the step of most sensors";
    JITTER_RAD = 8.7e-5 "rad": "standard deviation of directions", "0.005 degrees are 4 mm at 50 m";
    NOISE_SHARE = 0.1 "share": "increase of the mean variance of ranges", "forms of noise differ by as much";
    ROWS_NOISE = 0.6 "share": "spread of the added variance over rows",
        "rows have ranges and angles of their own, where laws may have another form";
    DIRECTIONS_NOISE = 0.25 "share": "spread of the added variance over azimuth", "a quarter is an eighth of the noise";
    TAILS_SHARE = 3e-4 "share": "returns with a larger error", "one return in three thousand";
    TAILS_MORE = 0.2 "share": "the same, of those that the simulated side has", "things of the world are in the tails";

    // Losses.
    LOST_SHARE = 0.005 "share": "returns that are lost", "one in two hundred; laws of losses differ by as much";
    LOST_OF_KIND = 0.03 "share": "returns that are lost of one kind of surface", "their angles are known less well";
    LOST_SPREAD = 0.02 "share": "spread of the share lost over rows, azimuth or range", "laws leave about as much";
    PATCH_SHARE = 3e-4 "share": "returns that a patch of directions loses, of all", "one in three thousand";
    PATCH_LOST = 0.08 "share": "the same, of the returns in the patch", "laws leave as much in single directions";
    PACKETS_SHARE = 1e-3 "share": "returns that are lost in packets", "one in a thousand";
    SECOND_SHARE = 1e-3 "share": "second returns, difference of the sides", "one in a thousand shots";
    CUT_SHARE = 0.0015 "share": "returns beyond a smallest or largest range", "false alarms and lone things are fewer";
    BRIGHT_SHARE = 0.05 "share": "shots beside bright targets that are lost or moved", "of fewer, single signs decide";

    // Returns where the simulation has none.
    ALONE_SHARE = 8e-4 "share": "lone returns", "edges of things that the model lacks are as many";
    GROUPED_SHARE = 0.0015 "share": "returns in groups before surfaces", "a model lacks small things of the street";
    BEHIND_SHARE = 0.003 "share": "returns in groups behind surfaces", "surfaces of a model have no gaps and panes";
    SPRAY_SHARE = 2e-4 "share": "returns behind vehicles", "some droplets behind the nearest vehicle";
    BEAM_RAD = 3e-4 "rad": "width of a beam that mixes the ranges of an edge", "a tenth of a step of most sensors";

    // Intensity.
    GAIN_LN = 0.03 "ln": "factor between the intensities of both sides", "a detector does not notice 3 %";
    EXPONENT_LN = 0.03 "ln": "change by an exponent, root mean square over the returns", "that of a factor";
    ROWS_GAIN_LN = 0.02 "ln": "spread of the gains of rows", "surfaces are even in brightness to as much";

    // Labels and labelled objects.
    LABELS_M = 0.03 "m": "constant shift of labels", "labels are placed no better";
    OBJECTS_M = 0.07 "m": "constant shift of the returns of objects", "models of vehicles are off by as much";
    LABELS_MOVED_M = 0.02 "m": "displacement of labels, root mean square", "less than a constant shift";
    OBJECTS_MOVED_M = 0.04 "m": "displacement of the returns of objects, root mean square",
        "less than a constant shift";
    CLOCK_S = 0.001 "s": "time offset", "3 cm at 30 m/s";
    SCAN_S = 0.005 "s": "duration of a scan", "half of it is 7 cm at 30 m/s at either end";

    // Scans without a simulation.
    LASERS_RANGE_M = 0.002 "m": "spread of the range offsets of lasers, from scans alone",
        "planes are fitted to returns of the same scan, so that no error of a model is in it";
    LASERS_INTENSITY = 0.004 "share": "spread of the intensities of lasers, of the full scale, from scans alone",
        "that of a step of eight bits";
    LASERS_ELEVATION_DEG = 0.03 "degrees": "mean error of the elevations, from scans alone", "a turn of the scene";
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_listed_once_with_a_reason() {
        let mut names: Vec<_> = SIZES.iter().map(|size| size.name).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), SIZES.len());
        for size in SIZES {
            assert!(size.least > 0.0 && !size.what.is_empty() && !size.why.is_empty(), "{size:?}");
            assert!(["m", "rad", "degrees", "s", "share", "ln"].contains(&size.unit), "{size:?}");
        }
    }

    /// The page on the method has the same table.
    #[test]
    fn the_book_lists_all_sizes() {
        let page = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/src/method/sizes.md");
        let page = std::fs::read_to_string(page).unwrap();
        let rows = SIZES.iter().map(|s| format!("| {} | {} {} | {} |", s.what, s.least, s.unit, s.why));
        let missing: Vec<String> = rows.filter(|row| !page.contains(row)).collect();
        assert!(missing.is_empty(), "docs/src/method/sizes.md lacks:\n{}", missing.join("\n"));
        assert_eq!(page.lines().filter(|line| line.starts_with("| ")).count(), SIZES.len() + 1, "rows and a head");
    }
}
