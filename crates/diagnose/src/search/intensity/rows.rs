//! Gains of single rows beyond the law of intensities.

use super::law::Law;
use super::{ROWS, Search, USUAL_SPREAD};
use crate::catalogue::sizes::ROWS_GAIN_LN;
use crate::catalogue::{Cause, Channel, Covariate, ParameterId, Quantity};
use crate::channels::groups::{Grouping, PartedFrame, total as group_total};
use crate::channels::intensity::Sample;
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Considered, Minimum, Status};
use crate::inference::choice::{Choice, Trial, total_and_z};
use crate::inference::grouped::{self, GroupFit};
use crate::search::{ChannelResult, Found, first_demands, parameter, record, with_error};

/// What the selecting frames say of gains of rows.
struct TestOfRows {
    chosen: bool,
    /// Their spread, ln.
    std: f64,
    /// The smallest one that is reported.
    least: f64,
    considered: Vec<Considered>,
}
impl Search<'_> {
    /// Spread of the gains of rows beyond a law and their number, where they differ significantly.
    pub(super) fn rows_differ(&self, law: Option<&Law>) -> Option<[f64; 2]> {
        let of_law = |s: &Sample| law.map_or(0.0, |law| law.of(s));
        let rows = self.scale.rows(self.context.frames, self.context.rig, &of_law);
        let test = self.test_of_rows(&rows);
        test.chosen.then(|| {
            let groups = group_total(self.select.iter().flat_map(|&i| &rows[i]));
            [test.std, groups.len() as f64]
        })
    }

    /// Whether gains of rows beyond a law are significant on the selecting frames.
    fn test_of_rows(&self, rows: &[PartedFrame]) -> TestOfRows {
        let demands = first_demands();
        let blocks = self.context.blocks(&self.select);
        let gains = grouped::cross_part_gains(rows, &self.select, &blocks, ROWS, true);
        let all = group_total(self.select.iter().flat_map(|&i| &rows[i]));
        let std = grouped::rough_spread(&all, &grouped::offsets(&all, ROWS), ROWS);
        let least = ROWS_GAIN_LN * (self.scale.spread / USUAL_SPREAD).min(1.0) + self.scale.rounding;
        let above_floor = std > least;
        let trial =
            Trial { candidate: 0, cause: Cause::BeamIntensity, parameters: 2, gains, expected: vec![], above_floor };
        let (total, z) = total_and_z(&trial.gains);
        let chosen = above_floor && total > demands.nats && z > demands.z;
        let rays = self.context.returns(&self.select);
        let choice = chosen.then(Choice::of_one);
        let considered = record(&[trial], choice.as_ref(), Channel::Intensity, rays, &demands);
        TestOfRows { chosen, std, least, considered }
    }

    /// The finding of gains of single rows: of the light, before a response with the exponent `gamma`.
    pub(super) fn rows_found(&self, rows: &[PartedFrame], gamma: f64, result: &mut ChannelResult) -> Option<Found> {
        let test = self.test_of_rows(rows);
        result.considered.extend(test.considered);
        result.minimum.push((Cause::BeamIntensity, Minimum::new(Quantity::Std, test.least)));
        if !test.chosen {
            return None;
        }
        let all = group_total(self.estimate.iter().flat_map(|&i| &rows[i]));
        let std = grouped::rough_spread(&all, &grouped::offsets(&all, ROWS), ROWS);
        // Their mean is what the law leaves of the factor.
        let offsets = grouped::offsets(&all, GroupFit { centred: false, ..ROWS });
        let error = |group| 1.0 / (all[group].gram[0] + ROWS.precision).sqrt();
        let before = 1.0 / gamma.max(0.1);
        let n = offsets.len().max(2) as f64;
        let mut parameters = vec![parameter(Quantity::Std, before * std, before * std / (2.0 * (n - 1.0)).sqrt())];
        let name = |sensor: u8| self.context.rig.sensors[usize::from(sensor)].name.clone();
        parameters.extend(offsets.iter().map(|(group, offset)| {
            let id = ParameterId::Row { sensor: name(group.sensor), row: group.index.into() };
            (id, with_error(before * offset, before * error(group), Quantity::Std.unit()))
        }));
        let points = offsets.iter().map(|(group, offset)| CurvePoint {
            sensor: usize::from(group.sensor),
            x: group.place(Grouping::Row),
            measured: offset.exp(),
            before: 1.0,
            after: offset.exp(),
            error: offset.exp() * error(group),
        });
        let gain = |&i: &usize| rows[i].iter().map(|part| grouped::gain(part, 0, &offsets)).sum();
        Some(Found {
            status: Status::Named,
            causes: vec![Cause::BeamIntensity],
            parameters,
            confidence: 1.0,
            channel: Channel::Intensity,
            covariate: Covariate::Row,
            held_out_gains: self.hold_out.iter().map(gain).collect(),
            says: format!(
                "rows differ in intensity on the same surfaces: by {:.1} % from one to the next",
                100.0 * (std.exp() - 1.0)
            ),
            separate_by: None,
            curve: Curve {
                x: "row".into(),
                y: "measured over simulated intensity".into(),
                by_sensor: true,
                points: points.collect(),
            },
            effects: vec![],
        })
    }
}
