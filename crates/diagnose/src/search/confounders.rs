//! What findings leave in channels that look at something else: dropped, and said among the candidates.

use super::{ChannelResult, Found};
use crate::diagnosis::{Parameter, Status};
use crate::inference::choice::UNNAMED;

/// What one finding leaves of another kind.
struct Leftover {
    /// What is left.
    what: fn(&Found) -> bool,
    /// By what.
    by: fn(&Found) -> bool,
    /// Share of the gain of that below which it is no finding of its own.
    share: f64,
    /// Why.
    because: &'static str,
}

/// In the order in which they are dropped: what is dropped leaves nothing itself.
const LEFTOVERS: [Leftover; 18] = [
    Leftover {
        what: |f| names(f, "sensor_extrinsics"),
        by: |f| names(f, "ego_occlusion"),
        share: 0.05,
        because: "the own car decides which surfaces the sensor still sees",
    },
    Leftover {
        what: |f| names(f, "sensor_extrinsics"),
        by: aims,
        share: 0.35,
        because: "the mean of what rows aim elsewhere by",
    },
    Leftover {
        what: |f| names(f, "sensor_extrinsics"),
        by: slide,
        share: 2.0,
        because: "the scene was moved back along the scan, but for an error",
    },
    Leftover {
        what: slight_bias,
        by: |f| f.channel == "hits",
        share: 0.1,
        because: "where far returns are lost, those that come back are the nearer ones",
    },
    Leftover {
        what: |f| f.channel == "roughness",
        by: |f| f.causes.first().is_some_and(|c| c.starts_with("beam_")),
        share: 0.15,
        because: "offsets of rows are mended but for their errors",
    },
    Leftover {
        what: |f| f.channel == "roughness",
        by: aims,
        share: 2.5,
        because: "on the ground the range jumps from row to row where rows aim elsewhere",
    },
    Leftover {
        what: |f| names(f, "outliers"),
        by: slide,
        share: 0.5,
        because: "returns that a scene that slides left alone",
    },
    Leftover {
        what: |f| names(f, "mixed_pixels"),
        by: |f| names(f, "missing_object"),
        share: 0.05,
        because: "things that stand before edges lie between what these show",
    },
    Leftover {
        what: |f| names(f, "mixed_pixels"),
        by: |f| names(f, "angular_jitter"),
        share: 0.001,
        because: "returns that jitter carried across edges",
    },
    Leftover {
        what: |f| names(f, "mixed_pixels"),
        by: aims,
        share: 0.1,
        because: "rows that aim elsewhere see past edges",
    },
    Leftover {
        what: |f| names(f, "missing_object") && number(f, "share") < FEW_THINGS,
        by: shapes,
        share: f64::INFINITY,
        because: "parts of objects of another shape",
    },
    Leftover {
        what: |f| names(f, "material_dropout") && number(f, "share") < 0.0,
        by: shapes,
        share: f64::INFINITY,
        because: "larger objects have more returns, none of which were lost before",
    },
    Leftover {
        what: |f| names(f, "missing_object"),
        by: slide,
        share: f64::INFINITY,
        because: "things that move by themselves slide otherwise than what stands",
    },
    Leftover {
        what: |f| f.channel == "hits",
        by: |f| f.channel == "residuals" && names(f, "rolling_shutter"),
        share: 0.2,
        because: "the scene shears, and rays pass the edges of what they met",
    },
    Leftover {
        what: |f| matches!(f.channel, "hits" | "roughness" | "returns"),
        by: pose,
        share: 0.005,
        because: "the scene was moved back, but for an error",
    },
    Leftover {
        what: |f| names(f, "missing_object") && number(f, "share") < 0.0,
        by: pose,
        share: 0.3,
        because: "from where the sensor is, other things are looked over",
    },
    Leftover { what: pose, by: unnamed, share: 0.25, because: "a part of what is off in a way without a name" },
    Leftover {
        // A scan that shears the scene makes surfaces without a name itself.
        what: |f| f.channel == "objects" && !names(f, "rolling_shutter"),
        by: unnamed,
        share: 0.05,
        because: "a part of what is off in a way without a name",
    },
];

/// Share of returns below which things beside objects of another shape are parts of these.
const FEW_THINGS: f64 = 0.004;

/// Share of the spread of the rows' offsets in range below which noise, at 20 m, is what mending them leaves.
const NOISE_OF_ROWS: f64 = 0.25;

/// Nats a return below which a law of noise is left by surfaces that stand elsewhere, slide or mix, and by surfaces that are off in a way without a name.
const NOISE_OF_SURFACES: [f64; 2] = [0.03, 0.1];

/// Times what surfaces are off by in a way without a name up to which shifts of objects are a part of that.
const SHIFTS_OF_SURFACES: f64 = 1.5;

/// Whether a finding has this cause, and no other.
fn names(f: &Found, cause: &str) -> bool {
    f.causes == [cause]
}

/// Whether rows aim elsewhere.
fn aims(f: &Found) -> bool {
    names(f, "beam_elevation_offset")
}

/// Whether the scene slides over a scan.
fn slide(f: &Found) -> bool {
    f.channel == "slide"
}

/// Whether objects may have another shape.
fn shapes(f: &Found) -> bool {
    f.causes.iter().any(|c| c == "wrong_shape")
}

/// Whether the car leans or a sensor is mounted otherwise.
fn pose(f: &Found) -> bool {
    f.channel == "residuals" && f.causes.iter().any(|c| matches!(c.as_str(), "pitch_roll" | "sensor_extrinsics"))
}

/// Whether surfaces are off in a way without a name.
fn unnamed(f: &Found) -> bool {
    f.channel == "residuals" && f.status == Status::Unexplained
}

/// Whether a finding is a bias of range of less than 4 cm at 30 m.
fn slight_bias(f: &Found) -> bool {
    names(f, "range_bias") && (number(f, "offset_m") + 30.0 * number(f, "scale")).abs() < 0.04
}

/// A number of a finding, 0 where it has not got it.
fn number(f: &Found, name: &str) -> f64 {
    f.parameters.iter().find(|(n, _)| n == name).map_or(0.0, |(_, p)| p.estimate)
}

/// Gain on the frames held out, nats.
fn gain(f: &Found) -> f64 {
    f.held_out_gains.iter().sum()
}

/// The largest of numbers of findings.
fn most(results: &[ChannelResult], of: impl Fn(&Found) -> Option<f64>) -> Option<f64> {
    results.iter().flat_map(|r| &r.found).filter_map(of).reduce(f64::max)
}

/// Drops findings, and says why among the candidates.
fn drop_all(results: &mut [ChannelResult], because: &str, what: impl Fn(&Found) -> bool) {
    for result in results {
        let (dropped, kept) = std::mem::take(&mut result.found).into_iter().partition(&what);
        result.found = kept;
        let dropped: Vec<Found> = dropped;
        for f in dropped {
            let cause = f.causes.first().map_or(UNNAMED, String::as_str);
            let of_it = result.considered.iter_mut().filter(|c| c.cause == cause && c.channel == f.channel);
            of_it.filter(|c| c.outcome.starts_with("chosen")).for_each(|c| c.outcome = format!("left over: {because}"));
        }
    }
}

/// Numbers that say what form an effect has and where it begins, not how large it is.
const FORM: [&str; 11] = [
    "reach_m",
    "divergence_rad",
    "share_on_comb",
    "simulated_std_m",
    // Of laws of losses.
    "most",
    "steepness",
    "half_at_m",
    "cos_half",
    "threshold",
    "brighter_standing",
    "brighter_objects",
];

/// Whether a finding is more than chance on the frames that say how large it is: intervals of some number exclude 0, where it has any.
fn speaks(f: &Found) -> bool {
    let sized = |(name, p): &&(String, Parameter)| p.unit != "number" && !FORM.contains(&name.as_str());
    let mut sizes = f.parameters.iter().filter(sized).map(|(_, p)| p).peekable();
    // That labels differ from labels is no chance, whatever of it is known.
    f.channel == "labels" || sizes.peek().is_none() || sizes.any(|p| p.ci95[0] * p.ci95[1] > 0.0)
}

/// Drops what a pose that was moved back, rows that were mended, and a scene that slid leave in channels that look at single returns. `returns` are those of
/// the frames that were held out.
pub fn without_leftovers(results: &mut [ChannelResult], returns: f64) {
    let spoke: Vec<bool> = results.iter().map(|r| !r.found.is_empty()).collect();
    drop_all(results, "the frames that say how large it is do not tell it from nothing", |f| !speaks(f));
    let rows_m = most(results, |f| names(f, "beam_range_offset").then(|| number(f, "std_m"))).unwrap_or(0.0);
    let noise_m = |f: &Found| number(f, "std_m") + 20.0 * number(f, "per_m");
    drop_all(results, "offsets of rows are mended but for their errors", |f| {
        names(f, "range_noise") && noise_m(f) < NOISE_OF_ROWS * rows_m
    });
    for Leftover { what, by, share, because } in LEFTOVERS {
        if let Some(most) = most(results, |f| by(f).then(|| gain(f))) {
            let least = share * most.max(f64::MIN_POSITIVE);
            drop_all(results, because, |f| what(f) && gain(f) < least);
        }
    }
    let off_m = |f: &Found| f.curve.points.iter().map(|p| p.measured.abs()).reduce(f64::max);
    let off_m = most(results, |f| if unnamed(f) { off_m(f) } else { None });
    let shifts_by_less = |f: &Found, m: f64| {
        let mut lengths = f.parameters.iter().filter(|(_, p)| p.unit == "m").map(|(_, p)| p.estimate.abs()).peekable();
        lengths.peek().is_some() && lengths.all(|l| l < m)
    };
    drop_all(results, "a part of what is off in a way without a name", |f| {
        let shifts_m = SHIFTS_OF_SURFACES * off_m.unwrap_or(0.0);
        f.channel == "objects" && !names(f, "rolling_shutter") && shifts_by_less(f, shifts_m)
    });
    let disturbs = |f: &Found| matches!(f.channel, "residuals" | "slide") || names(f, "mixed_pixels");
    for (nats, by) in NOISE_OF_SURFACES.into_iter().zip([&disturbs as &dyn Fn(&Found) -> bool, &unnamed]) {
        if results.iter().flat_map(|r| &r.found).any(by) {
            let least = nats * returns;
            drop_all(results, "surfaces stand elsewhere", |f| f.channel == "roughness" && gain(f) < least);
        }
    }
    // What mending leaves explains nothing, and no sensor model could close it; nor are labels mended for it.
    for (result, spoke) in results.iter_mut().zip(spoke) {
        if spoke && result.found.is_empty() {
            result.repairs.clear();
            result.distance.iter_mut().for_each(|d| (d[1], d[2]) = (0.0, 0.0));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnosis::{Considered, Curve};
    use crate::search::parameter;

    fn found(cause: &str, channel: &'static str, gain: f64, parameters: Vec<(String, Parameter)>) -> Found {
        Found {
            status: if cause.is_empty() { Status::Unexplained } else { Status::Named },
            causes: if cause.is_empty() { vec![] } else { vec![cause.into()] },
            family: "",
            parameters,
            confidence: 1.0,
            channel,
            covariate: String::new(),
            held_out_gains: vec![gain; 10],
            says: String::new(),
            separate_by: None,
            curve: Curve { x: String::new(), y: String::new(), points: vec![] },
        }
    }

    /// What is left of findings beside the first, on 1,000 returns held out.
    fn left(all: Vec<Found>) -> Vec<String> {
        let mut results: Vec<ChannelResult> =
            all.into_iter().map(|f| ChannelResult { found: vec![f], ..ChannelResult::default() }).collect();
        without_leftovers(&mut results, 1000.0);
        results.into_iter().skip(1).flat_map(|r| r.found).flat_map(|f| f.causes).collect()
    }

    #[test]
    fn what_others_leave_is_dropped_and_what_stands_for_itself_is_kept() {
        let number = |name: &str, value: f64| vec![parameter(name, value, 0.1 * value.abs(), "1")];
        let cases = [
            // (first, its gain), (second, its channel, its size, gain that is left over, gain that stands for itself)
            (("beam_elevation_offset", "residuals", 3.0), ("mixed_pixels", "returns", 0.003, 0.2, 0.4)),
            (("sensor_extrinsics", "residuals", 40.0), ("missing_object", "returns", -0.005, 11.0, 13.0)),
            (("sensor_extrinsics", "residuals", 40.0), ("missing_object", "returns", 0.005, 0.1, 3.0)),
            (("rolling_shutter", "residuals", 4.0), ("random_dropout", "hits", 0.005, 0.7, 0.9)),
            (("rolling_shutter", "slide", 4.0), ("outliers", "returns", 0.004, 1.9, 2.1)),
            (("", "residuals", 1.0), ("time_offset", "objects", 0.002, 0.04, 0.06)),
            (("", "residuals", 1.0), ("range_noise", "roughness", 0.02, 9.0, 11.0)),
        ];
        for ((first, channel, gain), (second, of, size, left_over, itself)) in cases {
            let beside = |g| {
                left(vec![found(first, channel, gain, number("a", 1.0)), found(second, of, g, number("share", size))])
            };
            assert!(beside(left_over).is_empty(), "{second} {left_over}");
            assert_eq!(beside(itself), [second]);
        }
    }

    #[test]
    fn what_is_dropped_is_said_among_the_candidates() {
        let considered = |cause: &str, outcome: &str| Considered {
            cause: cause.into(),
            channel: "returns".into(),
            nats_per_ray: 0.1,
            z: 5.0,
            outcome: outcome.into(),
        };
        let of_returns = ChannelResult {
            found: vec![found("mixed_pixels", "returns", 0.2, vec![]), found("range_cut", "returns", 0.2, vec![])],
            considered: vec![
                considered("mixed_pixels", "chosen"),
                considered("mixed_pixels", "gains less"),
                considered("range_cut", "chosen"),
            ],
            ..ChannelResult::default()
        };
        let aims = found("beam_elevation_offset", "residuals", 3.0, vec![]);
        let mut results = [of_returns, ChannelResult { found: vec![aims], ..ChannelResult::default() }];
        without_leftovers(&mut results, 1000.0);
        let outcomes: Vec<&str> = results[0].considered.iter().map(|c| c.outcome.as_str()).collect();
        assert_eq!(outcomes, ["left over: rows that aim elsewhere see past edges", "gains less", "chosen"]);
    }

    #[test]
    fn an_interval_about_nothing_is_no_finding() {
        let sensor = || ("sensor".to_owned(), Parameter { estimate: 2.0, unit: "number".into(), ci95: [2.0, 2.0] });
        let about =
            |value: f64| found("time_offset", "objects", 1.0, vec![sensor(), parameter("offset_s", value, 0.003, "s")]);
        let first = || found("range_bias", "residuals", 1.0, vec![]);
        assert!(left(vec![first(), about(-0.0006)]).is_empty());
        assert_eq!(left(vec![first(), about(-0.02)]), ["time_offset"]);
        let of_labels = Found { channel: "labels", ..about(-0.0006) };
        assert_eq!(left(vec![first(), of_labels]), ["time_offset"], "how large is not known, that it is there is");
        assert_eq!(left(vec![first(), found("missing_object", "returns", 1.0, vec![])]), ["missing_object"]);
        let things = |share: f64| found("missing_object", "returns", 1.0, vec![parameter("share", share, 0.0003, "1")]);
        let shapes = || found("wrong_shape", "objects", 1.0, vec![]);
        assert!(left(vec![shapes(), things(0.002)]).is_empty(), "parts of larger objects");
        assert_eq!(left(vec![first(), things(0.002)]), ["missing_object"]);
        let more = found("material_dropout", "hits", 1.0, vec![parameter("share", -0.3, 0.01, "1")]);
        assert!(left(vec![shapes(), more]).is_empty());
        let rows = || found("beam_range_offset", "residuals", 1.0, vec![parameter("std_m", 0.07, 0.001, "m")]);
        let noise = |std_m: f64| found("range_noise", "roughness", 9.0, vec![parameter("std_m", std_m, 0.0002, "m")]);
        assert!(left(vec![rows(), noise(0.007)]).is_empty(), "what mending rows leaves");
        assert_eq!(left(vec![rows(), noise(0.02)]), ["range_noise"]);
        // Half of such a law may lie at no angle that there is.
        let grazing = vec![parameter("cos_half", 0.001, 0.01, "1"), parameter("steepness", 0.3, 0.02, "1")];
        assert_eq!(left(vec![first(), found("incidence_dropout", "hits", 1.0, grazing)]), ["incidence_dropout"]);
    }
}
