//! What findings leave in channels that look at something else: dropped.

use super::{ChannelResult, Found};
use crate::diagnosis::{Parameter, Status};

/// Share of a pose's gain below which a finding of another channel is what moving the scene back leaves.
const LEFT_BY_A_POSE: f64 = 0.005;

/// Share of the gain of offsets of rows below which a law of noise is what mending them leaves.
const LEFT_BY_ROWS: f64 = 0.15;

/// Share of the gain of losses below which a slight bias of range is a matter of which returns are left.
const LEFT_BY_LOSSES: f64 = 0.04;

/// Whether a finding is a bias of range of less than 4 cm at 30 m.
fn slight_bias(f: &Found) -> bool {
    f.causes == ["range_bias"] && (number(f, "offset_m") + 30.0 * number(f, "scale")).abs() < 0.04
}

/// Nats a return below which a law of noise beside surfaces that stand elsewhere, slide or mix is what these leave.
const LEFT_OF_NOISE: f64 = 0.03;

/// Times the gain of rows that aim elsewhere below which a law of noise is what is left of the jumps between rows on the ground.
const LEFT_BY_AIMS: f64 = 2.5;

/// Share of the gain of rows that aim elsewhere below which the pose of a sensor is what their mean leaves.
const LEFT_BY_ROWS_OF_A_POSE: f64 = 0.35;

/// Share of what the own car hides below which a sensor's pose is a matter of which surfaces it still sees.
const LEFT_BY_OWN_CAR: f64 = 0.05;

/// Share of the gain of missing things below which mixed ranges are their returns.
const LEFT_BY_THINGS: f64 = 0.05;

/// Share of the gain of rows that aim elsewhere below which mixed ranges are returns of rows that see past edges.
const LEFT_BY_AIMS_OF_MIXED: f64 = 0.1;

/// Share of returns below which things beside objects of another shape are parts of these.
const LEFT_BY_SHAPES: f64 = 0.004;

/// Share of the gain of jitter below which mixed ranges are returns that it carried across edges.
const LEFT_BY_JITTER: f64 = 0.001;

/// Share of a pose's gain below which things that only the simulation has are what is looked over from there.
const LEFT_BY_A_POSE_OF_THINGS: f64 = 0.3;

/// Share of the gain of a scene that slides below which false alarms are returns that it left alone.
const LEFT_BY_A_SLIDE: f64 = 0.5;

/// Share of the spread of the rows' offsets in range below which noise, at 20 m, is what mending them leaves.
const LEFT_BY_ROWS_OF_NOISE: f64 = 0.25;

/// Nats a return below which a law of noise beside surfaces that are off in a way without a name is a part of that, share of what this gains
/// below which poses are, times what surfaces are off by up to which shifts of objects are, and share of its gain below which anything that objects show is.
const LEFT_BY_THE_UNNAMED: [f64; 4] = [0.1, 0.25, 1.5, 0.05];

/// Standard errors by which a sensor's pose must be off in one number: its six take up what is wrong with the few surfaces that it alone sees.
const SURE_OF_A_SENSOR: f64 = 4.5;

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
    let of_sensor = f.causes == ["sensor_extrinsics"];
    let sized = |(name, p): &&(String, Parameter)| p.unit != "number" && !FORM.contains(&name.as_str());
    let mut sizes = f.parameters.iter().filter(sized).map(|(_, p)| p).peekable();
    let sure = |p: &Parameter| p.estimate.abs() > SURE_OF_A_SENSOR / 1.96 * (p.ci95[1] - p.ci95[0]) / 2.0;
    // That labels differ from labels is no chance, whatever of it is known.
    f.channel == "labels"
        || sizes.peek().is_none()
        || sizes.any(|p| p.ci95[0] * p.ci95[1] > 0.0 && (!of_sensor || sure(p)))
}

/// A number of a finding, 0 where it has not got it.
fn number(f: &Found, name: &str) -> f64 {
    f.parameters.iter().find(|(n, _)| n == name).map_or(0.0, |(_, p)| p.estimate)
}

/// Whether things are said to be in the simulation alone.
fn things_too_many(f: &Found) -> bool {
    f.causes == ["missing_object"] && number(f, "share") < 0.0
}

/// Drops what a pose that was moved back, rows that were mended, and a scene that slid leave in channels that look at single returns. `returns` are those of
/// the frames that were held out.
pub fn without_leftovers(results: &mut [ChannelResult], returns: f64) {
    let gain = |f: &Found| f.held_out_gains.iter().sum::<f64>();
    let most = |results: &[ChannelResult], of: &dyn Fn(&Found) -> bool| {
        results.iter().flat_map(|r| &r.found).filter(|f| of(f)).map(gain).fold(0.0, f64::max)
    };
    let spoke: Vec<bool> = results.iter().map(|r| !r.found.is_empty()).collect();
    results.iter_mut().for_each(|r| r.found.retain(speaks));
    let rows = most(results, &|f| f.causes.first().is_some_and(|c| c.starts_with("beam_")));
    let aims = most(results, &|f| f.causes == ["beam_elevation_offset"]);
    let things = most(results, &|f| f.causes == ["missing_object"]);
    let jitter = most(results, &|f| f.causes == ["angular_jitter"]);
    let losses = most(results, &|f| f.channel == "hits");
    let hidden = most(results, &|f| f.causes == ["ego_occlusion"]);
    let shapes = results.iter().flat_map(|r| &r.found).any(|f| f.causes.iter().any(|c| c == "wrong_shape"));
    let slides = results.iter().flat_map(|r| &r.found).any(|f| f.channel == "slide");
    let slide = most(results, &|f| f.channel == "slide");
    let rows_m = results.iter().flat_map(|r| &r.found).filter(|f| f.causes == ["beam_range_offset"]);
    let rows_m = rows_m.map(|f| number(f, "std_m")).fold(0.0, f64::max);
    for result in results.iter_mut() {
        let least = (LEFT_BY_OWN_CAR * hidden).max(LEFT_BY_ROWS_OF_A_POSE * aims);
        result.found.retain(|f| f.causes != ["sensor_extrinsics"] || gain(f) >= least);
        // Where far returns are lost, those that come back are the nearer ones.
        result.found.retain(|f| !(slight_bias(f) && gain(f) < LEFT_BY_LOSSES * losses));
        result.found.retain(|f| f.channel != "roughness" || gain(f) >= (LEFT_BY_ROWS * rows).max(LEFT_BY_AIMS * aims));
        let noise_m = |f: &Found| number(f, "std_m") + 20.0 * number(f, "per_m");
        result.found.retain(|f| f.causes != ["range_noise"] || noise_m(f) >= LEFT_BY_ROWS_OF_NOISE * rows_m);
        result.found.retain(|f| f.causes != ["outliers"] || gain(f) >= LEFT_BY_A_SLIDE * slide);
        // Things that stand before edges lie between what these show.
        let least = (LEFT_BY_THINGS * things).max(LEFT_BY_JITTER * jitter).max(LEFT_BY_AIMS_OF_MIXED * aims);
        result.found.retain(|f| f.causes != ["mixed_pixels"] || gain(f) >= least);
        result.found.retain(|f| !(shapes && f.causes == ["missing_object"] && number(f, "share") < LEFT_BY_SHAPES));
        // Larger objects have more returns, none of which were lost before.
        let gained = |f: &Found| f.causes == ["material_dropout"] && number(f, "share") < 0.0;
        result.found.retain(|f| !(shapes && gained(f)));
        // Things that move by themselves slide otherwise than what stands.
        result.found.retain(|f| !(slides && f.causes == ["missing_object"]));
    }
    let posed = |f: &Found| f.causes.iter().any(|c| matches!(c.as_str(), "pitch_roll" | "sensor_extrinsics"));
    let pose = most(results, &|f| f.channel == "residuals" && posed(f));
    for result in results.iter_mut() {
        result
            .found
            .retain(|f| !matches!(f.channel, "hits" | "roughness" | "returns") || gain(f) >= LEFT_BY_A_POSE * pose);
        result.found.retain(|f| !things_too_many(f) || gain(f) >= LEFT_BY_A_POSE_OF_THINGS * pose);
    }
    let unnamed = |f: &Found| f.channel == "residuals" && f.status == Status::Unexplained;
    let without_a_name = most(results, &unnamed);
    if without_a_name > 0.0 {
        let curves = results.iter().flat_map(|r| &r.found).filter(|f| unnamed(f)).flat_map(|f| &f.curve.points);
        let off_m = curves.map(|p| p.measured.abs()).fold(0.0, f64::max);
        let shifts_by_less = |f: &Found, m: f64| {
            let mut lengths =
                f.parameters.iter().filter(|(_, p)| p.unit == "m").map(|(_, p)| p.estimate.abs()).peekable();
            lengths.peek().is_some() && lengths.all(|l| l < m)
        };
        let left = |f: &Found| match f.channel {
            "roughness" => gain(f) < LEFT_BY_THE_UNNAMED[0] * returns,
            "residuals" => posed(f) && gain(f) < LEFT_BY_THE_UNNAMED[1] * without_a_name,
            // A scan that shears the scene makes such surfaces itself.
            "objects" => {
                let little = gain(f) < LEFT_BY_THE_UNNAMED[3] * without_a_name;
                f.causes != ["rolling_shutter"] && (little || shifts_by_less(f, LEFT_BY_THE_UNNAMED[2] * off_m))
            }
            _ => false,
        };
        results.iter_mut().for_each(|r| r.found.retain(|f| !left(f)));
    }
    let disturbs = |f: &Found| matches!(f.channel, "residuals" | "slide") || f.causes == ["mixed_pixels"];
    if results.iter().flat_map(|r| &r.found).any(disturbs) {
        let rough = |f: &Found| f.channel == "roughness" && gain(f) < LEFT_OF_NOISE * returns;
        results.iter_mut().for_each(|r| r.found.retain(|f| !rough(f)));
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
    use crate::diagnosis::Curve;
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
