//! Confounders across channels: findings that are side effects of others are dropped, and the reason is recorded.

use super::{ChannelResult, Found, NamedParameter, first_demands, mean_interval};
use crate::catalogue::{Cause, Channel, Covariate, Hypothesis, ParameterId, Quantity, Unit};
use crate::diagnosis::{Parameter, Status};

/// A confounder: a finding whose cause has a side effect that resembles another finding.
struct Confounder {
    /// The finding that may be a side effect.
    effect: fn(&Found) -> bool,
    /// The finding that causes the side effect.
    by: fn(&Found) -> bool,
    /// Share of the gain of the confounder below which the finding is dropped as a side effect.
    share: f64,
    /// The reason, as the list of what was considered has it.
    because: &'static str,
}

/// Confounders in the order in which they are applied: a finding that is dropped confounds nothing after it.
const CONFOUNDERS: [Confounder; 17] = [
    Confounder {
        effect: |f| f.is(Cause::SensorExtrinsics),
        by: |f| f.is(Cause::EgoOcclusion),
        share: 0.05,
        because: "what the ego vehicle hides decides which surfaces the sensor still sees",
    },
    Confounder {
        effect: |f| f.is(Cause::SensorExtrinsics),
        by: rows_aim_elsewhere,
        share: 0.35,
        because: "the mean of what rows aim elsewhere by",
    },
    Confounder {
        effect: |f| f.is(Cause::SensorExtrinsics),
        by: slide,
        share: 2.0,
        because: "the scene was moved back along the scan, but for an error",
    },
    Confounder {
        effect: slight_bias,
        by: |f| f.channel == Channel::Hits,
        share: 0.1,
        because: "where far returns are lost, those that come back are the nearer ones",
    },
    Confounder { effect: noise, by: rows, share: 0.15, because: "offsets of rows are mended but for their errors" },
    Confounder {
        effect: noise,
        by: rows_aim_elsewhere,
        share: 2.5,
        because: "on the ground the range jumps from row to row where rows aim elsewhere",
    },
    Confounder {
        effect: lone,
        by: |f| f.is(Cause::HeavyTails),
        share: 0.5,
        because: "the farthest of the ranges that are off",
    },
    Confounder {
        // The scene is moved back to the middle of the scan, but was seen from places metres apart.
        effect: |f| f.is(Cause::Outliers),
        by: slide,
        share: 0.5,
        because: "returns that a scene that slides left alone",
    },
    Confounder {
        effect: |f| f.is(Cause::MaterialDropout) && number(f, Quantity::Share) < 0.0,
        by: shapes,
        share: f64::INFINITY,
        because: "larger objects have more returns, none of which were lost before",
    },
    Confounder {
        effect: |f| f.is(Cause::MissingObject),
        by: slide,
        share: f64::INFINITY,
        because: "things that move by themselves slide otherwise than what stands",
    },
    Confounder {
        effect: |f| f.channel == Channel::Hits,
        by: |f| f.channel == Channel::Residuals && f.is(Cause::RollingShutter),
        share: 0.2,
        because: "the scene shears, and rays pass the edges of what they met",
    },
    Confounder {
        effect: |f| matches!(f.channel, Channel::Hits | Channel::Returns) || noise(f),
        by: pose,
        share: 0.005,
        because: "the scene was moved back, but for an error",
    },
    Confounder {
        effect: |f| f.is(Cause::MissingObject) && number(f, Quantity::Share) < 0.0,
        by: pose,
        share: 0.3,
        because: "from where the sensor is, other things are looked over",
    },
    Confounder {
        // An error of a seventh is a fiftieth of the gain, and objects have a twentieth of the returns.
        effect: shapes,
        by: ranges,
        share: 0.001,
        because: "ranges were corrected but for an error, and objects that look nearer look longer",
    },
    Confounder {
        effect: pose,
        by: unexplained_surfaces,
        share: 0.25,
        because: "a part of what is off in a way without a name",
    },
    Confounder {
        effect: noise,
        by: unexplained_surfaces,
        share: 1.0,
        because: "offsets that change from ray to ray are rough, and were not corrected",
    },
    Confounder {
        // Motion distortion makes unexplained offsets of surfaces itself.
        effect: |f| f.channel == Channel::Objects && !f.is(Cause::RollingShutter),
        by: unexplained_surfaces,
        share: 0.05,
        because: "a part of what is off in a way without a name",
    },
];

/// Causes of single rows.
const BEAM_CAUSES: [Cause; 3] = [Cause::BeamElevationOffset, Cause::BeamIntensity, Cause::BeamRangeOffset];

/// Range noise at 20 m below this share of the spread of per-row range offsets is the error of their correction.
const NOISE_OF_ROWS: f64 = 0.25;

/// Shifts of objects below this many times the largest unexplained offset of surfaces are a part of that offset.
const SHIFTS_OF_SURFACES: f64 = 1.5;

/// Whether returns are alone in the air.
fn lone(f: &Found) -> bool {
    f.causes.iter().any(|c| matches!(c, Cause::Outliers | Cause::Fog | Cause::Rain | Cause::Spray))
}

/// Whether a finding is noise of many shots: single ones that are far off the shots around them come from no surface
/// that stands elsewhere.
fn noise(f: &Found) -> bool {
    f.channel == Channel::Roughness && !f.is(Cause::HeavyTails)
}

/// Whether rows have elevation offsets.
fn rows_aim_elsewhere(f: &Found) -> bool {
    f.is(Cause::BeamElevationOffset)
}

/// Whether ranges are off, alike or by row.
fn ranges(f: &Found) -> bool {
    f.is(Cause::RangeBias) || f.is(Cause::RangeDrift) || f.is(Cause::BeamRangeOffset)
}

/// Whether the scene is displaced along the scan.
fn slide(f: &Found) -> bool {
    f.channel == Channel::Slide
}

/// Whether objects may have another shape.
fn shapes(f: &Found) -> bool {
    f.causes.contains(&Cause::WrongShape)
}

/// Whether the ego vehicle is tilted or a sensor is mounted otherwise.
fn pose(f: &Found) -> bool {
    let turns = [Cause::EgoAttitude, Cause::PitchRoll, Cause::SensorExtrinsics];
    f.channel == Channel::Residuals && f.causes.iter().any(|c| turns.contains(c))
}

/// Whether surfaces have unexplained offsets in some directions.
fn unexplained_surfaces(f: &Found) -> bool {
    let of_directions = !matches!(f.covariate, Covariate::Range | Covariate::Row);
    f.channel == Channel::Residuals && f.status == Status::Unexplained && of_directions
}

/// Whether rows have values of their own, with or without a name.
fn rows(f: &Found) -> bool {
    f.covariate == Covariate::Row && f.channel == Channel::Residuals
        || f.causes.first().is_some_and(|c| BEAM_CAUSES.contains(c))
}

/// Whether a finding is a bias of range of less than 4 cm at 30 m.
fn slight_bias(f: &Found) -> bool {
    f.is(Cause::RangeBias) && (number(f, Quantity::OffsetM) + 30.0 * number(f, Quantity::Scale)).abs() < 0.04
}

/// A parameter of a finding; 0 without it.
fn number(f: &Found, quantity: Quantity) -> f64 {
    f.parameter(quantity).map_or(0.0, |p| p.estimate)
}

/// Gain on the held-out frames, nats.
fn gain(f: &Found) -> f64 {
    f.held_out_gains.iter().sum()
}

/// The largest of a number over findings.
fn most(results: &[ChannelResult], of: impl Fn(&Found) -> Option<f64>) -> Option<f64> {
    results.iter().flat_map(|r| &r.found).filter_map(of).reduce(f64::max)
}

/// Drops findings, and records the reason among the hypotheses that were considered.
fn drop_all(results: &mut [ChannelResult], because: &str, what: impl Fn(&Found) -> bool) {
    for result in results {
        let (dropped, kept) = std::mem::take(&mut result.found).into_iter().partition(&what);
        result.found = kept;
        let dropped: Vec<Found> = dropped;
        for f in dropped {
            let cause = Hypothesis::from(f.causes.first().copied().unwrap_or(Cause::Unexplained));
            let of_it = result.considered.iter_mut().filter(|c| c.cause == cause && c.channel == f.channel);
            of_it.filter(|c| c.outcome.starts_with("chosen")).for_each(|c| c.outcome = format!("left over: {because}"));
        }
    }
}

/// Parameters of the form of an effect, not of its size.
const FORM: [Quantity; 16] = [
    Quantity::Aspect,
    Quantity::Sharpness,
    Quantity::ReachM,
    Quantity::DivergenceRad,
    Quantity::PulseM,
    Quantity::ShareOnComb,
    Quantity::SimulatedStdM,
    Quantity::Uneven,
    // Of laws of losses.
    Quantity::Most,
    Quantity::Steepness,
    Quantity::HalfAtM,
    Quantity::CosHalf,
    Quantity::Threshold,
    Quantity::BrighterStanding,
    Quantity::BrighterObjects,
    Quantity::BrighterWheels,
];

/// Whether the size of a finding is significant on the estimating frames: some parameter of size, where it has one, is
/// not 0, at a level of 5 % for all of them together (Bonferroni). A difference of labels is no chance, even where none
/// of its parameters is known, nor are packets, of which a few runs among all frames are compared with two controls.
fn has_significant_size(f: &Found) -> bool {
    let is_form = |id: &ParameterId| matches!(id, ParameterId::Of(quantity) if FORM.contains(quantity));
    let sized = |(id, p): &&NamedParameter| p.unit != Unit::Number && !is_form(id);
    let sizes: Vec<&Parameter> = f.parameters.iter().filter(sized).map(|(_, p)| p).collect();
    let level = 0.05 / sizes.len() as f64;
    let by_itself = matches!(f.channel, Channel::Labels | Channel::Packets);
    by_itself || sizes.is_empty() || sizes.iter().any(|p| by_chance(p) < level)
}

/// Probability that a parameter is as far from 0 by chance: normal, with the end of its interval towards 0 at 1.96
/// standard errors.
fn by_chance(p: &Parameter) -> f64 {
    let half = if p.estimate > 0.0 { p.estimate - p.ci95[0] } else { p.ci95[1] - p.estimate };
    libm::erfc(1.96 * p.estimate.abs() / half.max(1e-300) / 2f64.sqrt())
}

/// Whether the held-out frames speak against a finding by as much as the selection demands for one.
fn is_refused(f: &Found) -> bool {
    gain(f) < -first_demands().nats
}

/// Whether the estimating frames tell the size of a finding from nothing, and the held-out frames do not refuse it.
pub fn is_confirmed(f: &Found) -> bool {
    has_significant_size(f) && !is_refused(f)
}

/// Whether the interval of the gain of the held-out frames begins below zero: they may as well be less likely with a
/// finding. Of packets a few runs among all frames show it.
fn may_lose(f: &Found, blocks: &[usize]) -> bool {
    f.channel != Channel::Packets && mean_interval(&f.held_out_gains, blocks, 1.0).ci95[0] < 0.0
}

/// Drops findings that are side effects of others: remainders of corrections (pose, rows, motion distortion) in
/// channels of single returns, and findings without a significant size, or that the held-out frames do not confirm;
/// `blocks` are those of the latter.
pub fn drop_confounded(results: &mut [ChannelResult], blocks: &[usize]) {
    let had_findings: Vec<bool> = results.iter().map(|r| !r.found.is_empty()).collect();
    drop_all(results, "the frames that say how large it is do not tell it from nothing", |f| !has_significant_size(f));
    drop_all(results, "the held-out frames may as well be less likely with it", |f| may_lose(f, blocks));
    drop_noise_of_rows(results);
    for Confounder { effect, by, share, because } in CONFOUNDERS {
        if let Some(most) = most(results, |f| by(f).then(|| gain(f))) {
            let least = share * most.max(f64::MIN_POSITIVE);
            drop_all(results, because, |f| effect(f) && gain(f) < least);
        }
    }
    drop_shifts_of_surfaces(results);
    // Remainders explain nothing, no sensor model could remove them, and labels are not corrected for them.
    for (result, had_findings) in results.iter_mut().zip(had_findings) {
        if had_findings && result.found.is_empty() {
            result.repairs.clear();
            result.distance.iter_mut().for_each(|d| (d[1], d[2]) = (0.0, 0.0));
        }
    }
}

/// Drops range noise that is small against the per-row range offsets that were corrected.
fn drop_noise_of_rows(results: &mut [ChannelResult]) {
    let of_rows = |f: &Found| f.is(Cause::BeamRangeOffset).then(|| number(f, Quantity::StdM));
    let rows_m = most(results, of_rows).unwrap_or(0.0);
    let noise_m = |f: &Found| number(f, Quantity::StdM) + 20.0 * number(f, Quantity::PerM);
    drop_all(results, "offsets of rows are mended but for their errors", |f| {
        f.is(Cause::RangeNoise) && noise_m(f) < NOISE_OF_ROWS * rows_m
    });
}

/// Drops shifts of objects that are small against unexplained offsets of surfaces.
fn drop_shifts_of_surfaces(results: &mut [ChannelResult]) {
    let off_m = |f: &Found| f.curve.points.iter().map(|p| p.measured.abs()).reduce(f64::max);
    let off_m = most(results, |f| if unexplained_surfaces(f) { off_m(f) } else { None });
    let shifts_by_less = |f: &Found, m: f64| {
        let lengths = f.parameters.iter().filter(|(_, p)| p.unit == Unit::Metre);
        let mut lengths = lengths.map(|(_, p)| p.estimate.abs()).peekable();
        lengths.peek().is_some() && lengths.all(|l| l < m)
    };
    drop_all(results, "a part of what is off in a way without a name", |f| {
        let shifts_m = SHIFTS_OF_SURFACES * off_m.unwrap_or(0.0);
        f.channel == Channel::Objects && !f.is(Cause::RollingShutter) && shifts_by_less(f, shifts_m)
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::curve::Curve;
    use crate::diagnosis::Considered;
    use crate::search::{parameter, sensor_number};

    /// Of the ten held-out frames of a finding.
    const BLOCKS: [usize; 10] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9];

    fn found(cause: Option<Cause>, channel: Channel, gain: f64, parameters: Vec<NamedParameter>) -> Found {
        Found {
            effects: Vec::new(),
            status: if cause.is_none() { Status::Unexplained } else { Status::Named },
            causes: cause.into_iter().collect(),
            parameters,
            confidence: 1.0,
            channel,
            covariate: Covariate::None,
            held_out_gains: vec![gain; 10],
            says: String::new(),
            separate_by: None,
            curve: Curve::default(),
        }
    }

    /// Causes that are kept beside the first.
    fn left(all: Vec<Found>) -> Vec<Cause> {
        let mut results: Vec<ChannelResult> = all.into_iter().map(|f| result(vec![f])).collect();
        drop_confounded(&mut results, &BLOCKS);
        results.into_iter().skip(1).flat_map(|r| r.found).flat_map(|f| f.causes).collect()
    }

    fn result(found: Vec<Found>) -> ChannelResult {
        ChannelResult { found, ..ChannelResult::new(Channel::Returns, 0) }
    }

    #[test]
    fn side_effects_are_dropped_and_findings_of_their_own_are_kept() {
        let number = |quantity, value: f64| vec![parameter(quantity, value, 0.1 * value.abs())];
        let cases = [
            // (first, its gain), (second, its channel, its size, gain of a side effect, gain of a finding of its own)
            (
                (Some(Cause::BeamElevationOffset), Channel::Residuals, 3.0),
                (Cause::RangeNoise, Channel::Roughness, 0.02, 7.4, 7.6),
            ),
            (
                (Some(Cause::SensorExtrinsics), Channel::Residuals, 40.0),
                (Cause::MissingObject, Channel::Returns, -0.005, 11.0, 13.0),
            ),
            (
                (Some(Cause::SensorExtrinsics), Channel::Residuals, 40.0),
                (Cause::MissingObject, Channel::Returns, 0.005, 0.1, 3.0),
            ),
            (
                (Some(Cause::RollingShutter), Channel::Residuals, 4.0),
                (Cause::RandomDropout, Channel::Hits, 0.005, 0.7, 0.9),
            ),
            ((Some(Cause::RollingShutter), Channel::Slide, 4.0), (Cause::Outliers, Channel::Returns, 0.004, 1.9, 2.1)),
            (
                (Some(Cause::RangeBias), Channel::Residuals, 40.0),
                (Cause::WrongShape, Channel::Objects, 0.1, 0.03, 0.05),
            ),
            ((None, Channel::Residuals, 1.0), (Cause::TimeOffset, Channel::Objects, 0.002, 0.04, 0.06)),
            ((None, Channel::Residuals, 1.0), (Cause::RangeNoise, Channel::Roughness, 0.02, 0.9, 1.1)),
        ];
        for ((first, channel, gain), (second, of, size, side_effect, own)) in cases {
            let beside = |g| {
                let first = found(first, channel, gain, number(Quantity::OffsetM, 1.0));
                left(vec![first, found(Some(second), of, g, number(Quantity::Share, size))])
            };
            assert!(beside(side_effect).is_empty(), "{second} {side_effect}");
            assert_eq!(beside(own), [second]);
        }
    }

    #[test]
    fn the_held_out_frames_confirm_a_finding() {
        let with_gains = |gains: [f64; 10]| {
            let held_out_gains = gains.to_vec();
            let found = Found { held_out_gains, ..found(Some(Cause::Blooming), Channel::Returns, 0.0, vec![]) };
            left(vec![found_of(Cause::RangeNoise), found])
        };
        assert_eq!(with_gains([4.0, 9.0, 3.0, -1.0, 5.0, 2.0, 8.0, 3.0, 6.0, 4.0]), [Cause::Blooming]);
        // Few frames show it, and none is less likely with it.
        assert_eq!(with_gains([0.0, 0.0, 90.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), [Cause::Blooming]);
        // One frame decides, against most.
        assert!(with_gains([-4.0, -3.0, 90.0, -5.0, -4.0, -6.0, -3.0, -2.0, -5.0, -4.0]).is_empty());
    }

    fn found_of(cause: Cause) -> Found {
        found(Some(cause), Channel::Roughness, 1.0, vec![])
    }

    #[test]
    fn the_reason_of_a_dropped_finding_is_recorded() {
        let considered = |cause: Cause, outcome: &str| Considered {
            cause: cause.into(),
            channel: Channel::Returns,
            nats_per_ray: 0.1,
            z: 5.0,
            outcome: outcome.into(),
        };
        let of_returns = ChannelResult {
            found: vec![
                found(Some(Cause::Outliers), Channel::Returns, 0.2, vec![]),
                found(Some(Cause::RangeCut), Channel::Returns, 0.2, vec![]),
            ],
            considered: vec![
                considered(Cause::Outliers, "chosen"),
                considered(Cause::Outliers, "gains less"),
                considered(Cause::RangeCut, "chosen"),
            ],
            ..result(vec![])
        };
        let slide = found(Some(Cause::RollingShutter), Channel::Slide, 3.0, vec![]);
        let mut results = [of_returns, result(vec![slide])];
        drop_confounded(&mut results, &BLOCKS);
        let outcomes: Vec<&str> = results[0].considered.iter().map(|c| c.outcome.as_str()).collect();
        assert_eq!(outcomes, ["left over: returns that a scene that slides left alone", "gains less", "chosen"]);
    }

    fn named(cause: Cause, channel: Channel, parameters: Vec<NamedParameter>) -> Found {
        found(Some(cause), channel, 1.0, parameters)
    }

    #[test]
    fn what_makes_held_out_frames_less_likely_is_no_finding() {
        let first = || found(Some(Cause::RangeCut), Channel::Hits, 4.0, vec![]);
        let beside = |gain: f64| {
            let share = vec![parameter(Quantity::Share, 0.1, 0.01)];
            left(vec![first(), found(Some(Cause::RandomDropout), Channel::Hits, gain, share)])
        };
        assert!(beside(-0.5).is_empty());
        assert_eq!(beside(0.5), [Cause::RandomDropout]);
    }

    #[test]
    fn an_interval_about_zero_is_no_finding() {
        let sensor = || sensor_number(2);
        let about = |value: f64| {
            named(Cause::TimeOffset, Channel::Objects, vec![sensor(), parameter(Quantity::OffsetS, value, 0.003)])
        };
        let first = || named(Cause::RangeBias, Channel::Residuals, vec![]);
        assert!(left(vec![first(), about(-0.0006)]).is_empty());
        assert_eq!(left(vec![first(), about(-0.02)]), [Cause::TimeOffset]);
        // Two standard errors: significant alone, and by chance among six.
        let turns = [Quantity::RollDeg, Quantity::PitchDeg, Quantity::YawDeg, Quantity::LeftM, Quantity::UpM];
        let more = turns.map(|quantity| parameter(quantity, 0.0001, 0.003));
        let pose = |list: Vec<NamedParameter>| named(Cause::SensorExtrinsics, Channel::Residuals, list);
        let one = || parameter(Quantity::ForwardM, 0.0063, 0.003);
        assert_eq!(left(vec![first(), pose(vec![one()])]), [Cause::SensorExtrinsics]);
        assert!(left(vec![first(), pose([vec![one()], more.to_vec()].concat())]).is_empty());
        let of_labels = Found { channel: Channel::Labels, ..about(-0.0006) };
        assert_eq!(left(vec![first(), of_labels]), [Cause::TimeOffset], "its size is not known, its presence is");
        assert_eq!(left(vec![first(), named(Cause::MissingObject, Channel::Returns, vec![])]), [Cause::MissingObject]);
        let shapes = || named(Cause::WrongShape, Channel::Objects, vec![]);
        let more = named(Cause::MaterialDropout, Channel::Hits, vec![parameter(Quantity::Share, -0.3, 0.01)]);
        assert!(left(vec![shapes(), more]).is_empty());
        let std_m = |value, error| vec![parameter(Quantity::StdM, value, error)];
        let rows = || named(Cause::BeamRangeOffset, Channel::Residuals, std_m(0.07, 0.001));
        let noise = |value: f64| found(Some(Cause::RangeNoise), Channel::Roughness, 9.0, std_m(value, 0.0002));
        assert!(left(vec![rows(), noise(0.007)]).is_empty(), "the error of the correction of rows");
        assert_eq!(left(vec![rows(), noise(0.02)]), [Cause::RangeNoise]);
        // One half of such a law may lie beyond all angles.
        let grazing = vec![parameter(Quantity::CosHalf, 0.001, 0.01), parameter(Quantity::Steepness, 0.3, 0.02)];
        let incidence = named(Cause::IncidenceDropout, Channel::Hits, grazing);
        assert_eq!(left(vec![first(), incidence]), [Cause::IncidenceDropout]);
    }
}
