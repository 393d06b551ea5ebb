//! The law of intensities: its form, its fit and its finding.

use super::{PRIOR, Search};
use crate::catalogue::sizes::{EXPONENT_LN, GAIN_LN};
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::intensity::{BRIGHTNESS, COS, GAIN, OF_THE_WORLD, RANGE, REFERENCE_M, Sample, ln_ratio};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Minimum, Parameter};
use crate::inference::choice::{Choice, Trial, significant, total_and_z};
use crate::inference::linear::{LinearFit, LinearFrame, cross_gains, fit};
use crate::search::{ChannelResult, Found, Selected, Z_STAR, first_demands, parameter, record};
use sensor::Effect;
use sensor::effects::IntensityResponse;

/// The form of a law.
#[derive(Clone, Debug, Default)]
pub(super) struct Form {
    /// Columns with an exponent.
    exponents: Vec<usize>,
    /// Whether kinds of surfaces have other reflectivities than in the simulation.
    world: bool,
}

impl Form {
    /// All forms.
    fn all() -> impl Iterator<Item = Form> {
        (0..16u32).map(|bits| Form {
            exponents: [RANGE, COS, BRIGHTNESS].into_iter().filter(|c| bits & 1 << c != 0).collect(),
            world: bits & 1 != 0,
        })
    }

    /// Its columns, the factor first.
    fn columns(&self) -> Vec<usize> {
        let world = if self.world { &OF_THE_WORLD[..] } else { &[] };
        [GAIN].into_iter().chain(world.iter().copied()).chain(self.exponents.iter().copied()).collect()
    }
}

/// A law: its form with the coefficients on some frames.
pub(super) struct Law {
    /// Exponents, with the reflectivities of the world.
    shape: LinearFit,
    /// The factor that serves all surfaces, and its standard error.
    gain: [f64; 2],
    pub(super) exponents: Vec<usize>,
}

impl Law {
    pub(super) fn of(&self, s: &Sample) -> f64 {
        self.gain[0] + self.exponents.iter().map(|&c| s.x[c] * self.coefficient(c)[0]).sum::<f64>()
    }

    /// Coefficient of a column with its standard error; zeros for those that it does not have.
    pub(super) fn coefficient(&self, column: usize) -> [f64; 2] {
        let at = self.shape.columns.iter().position(|c| *c == column).filter(|_| self.exponents.contains(&column));
        at.map_or([0.0; 2], |i| [self.shape.theta[i], self.shape.error(i)])
    }
}
impl Search<'_> {
    /// Gains of the selecting frames by the factor alone, fitted on other blocks.
    fn gains_of_factor(&self) -> Vec<f64> {
        let frames: Vec<&LinearFrame> = self.select.iter().map(|&i| &self.sums[i]).collect();
        cross_gains(&frames, &self.context.blocks(&self.select), &[GAIN], &PRIOR)
    }

    /// The form of the law: of all sets of exponents, with and without reflectivities of the world of their own, the
    /// one with the fewest parameters of those that predict other frames nearly as well as the best. `None` where not
    /// even a factor is needed.
    pub(super) fn form(&self, result: &mut ChannelResult) -> Option<Form> {
        let demands = first_demands();
        let (frames, blocks) = self.of(&self.select);
        let trials: Vec<(Form, Trial)> = Form::all()
            .map(|form| {
                let columns = form.columns();
                let fitted = fit(&frames, &blocks, &columns, &PRIOR);
                let rms = |c: &usize| {
                    let at = columns.iter().position(|own| own == c).expect("a column of the form");
                    fitted.theta[at].abs() * self.spread(&self.select, *c)
                };
                let above_floor = form.exponents.iter().all(|c| rms(c) > EXPONENT_LN);
                let gains = cross_gains(&frames, &blocks, &columns, &PRIOR);
                let cause = Cause::IntensityLaw;
                (form, Trial { candidate: 0, cause, parameters: columns.len(), gains, expected: vec![], above_floor })
            })
            .collect();
        let total = |t: &Trial| total_and_z(&t.gains).0;
        let able = || trials.iter().filter(|(_, t)| t.above_floor);
        let best = able().max_by(|a, b| total(&a.1).total_cmp(&total(&b.1))).expect("the factor alone is always able");
        let near = |t: &Trial| {
            let behind: Vec<f64> = best.1.gains.iter().zip(&t.gains).map(|(a, b)| a - b).collect();
            let (deficit, z) = total_and_z(&behind);
            deficit < demands.slack * (total(&best.1) - total(&trials[0].1)) || z < 2.0
        };
        let simplest = able().filter(|(_, t)| near(t));
        let (form, trial) = simplest
            .min_by(|a, b| a.1.parameters.cmp(&b.1.parameters).then(total(&b.1).total_cmp(&total(&a.1))))
            .expect("the best is near itself");
        let law = self.law(&self.select, form);
        // A factor that is different for every kind of surface is one of the world.
        let least = GAIN_LN.max(self.spread_of_kinds(&law)).max(Z_STAR * self.of_rows);
        let alone = form.exponents.is_empty();
        let above_floor = !alone || law.gain[0].abs() > least;
        let gains = if alone { self.gains_of_factor() } else { trial.gains.clone() };
        let (gain, z) = total_and_z(&gains);
        let chosen = above_floor && gain > demands.nats && (z > demands.z || significant(&gains, demands.z));
        let rays = self.context.returns(&self.select);
        let trial = Trial { above_floor, gains, ..trial.clone() };
        let choice = chosen.then(Choice::of_one);
        result.considered.extend(record(&[trial], choice.as_ref(), Channel::Intensity, rays, &demands));
        result.minimum.push((Cause::IntensityLaw, Minimum::new(Quantity::Gain, (Z_STAR * law.gain[1]).max(GAIN_LN))));
        chosen.then(|| form.clone())
    }

    /// Standard deviation of a column over the rays of frames, after the factor is taken out.
    fn spread(&self, which: &[usize], column: usize) -> f64 {
        let sum = |i: usize, j: usize| which.iter().map(|&f| self.sums[f].gram[(i, j)]).sum::<f64>();
        let n = sum(GAIN, GAIN).max(1e-12);
        (sum(column, column) / n - (sum(GAIN, column) / n).powi(2)).max(0.0).sqrt()
    }

    /// Root mean square of the reflectivities of kinds of surfaces beyond a law, about their mean.
    fn spread_of_kinds(&self, law: &Law) -> f64 {
        let sum = |i: usize, j: usize| self.select.iter().map(|&f| self.sums[f].gram[(i, j)]).sum::<f64>();
        let n = sum(GAIN, GAIN).max(1e-12);
        let of = |column: usize| {
            let at = law.shape.columns.iter().position(|c| *c == column);
            (sum(GAIN, column) / n, at.map_or(0.0, |at| law.shape.theta[at]))
        };
        let kinds = OF_THE_WORLD.map(of);
        let mean: f64 = kinds.iter().map(|(share, theta)| share * theta).sum();
        let square: f64 = kinds.iter().map(|(share, theta)| share * theta * theta).sum();
        (square - mean * mean).max(0.0).sqrt()
    }

    /// Fit of a law on some frames.
    pub(super) fn law(&self, which: &[usize], form: &Form) -> Law {
        let (frames, blocks) = self.of(which);
        let exponents = &form.exponents;
        let shape = fit(&frames, &blocks, &form.columns(), &PRIOR);
        let mut law = Law { shape, gain: [0.0; 2], exponents: exponents.clone() };
        // The factor that serves all surfaces: the mean of what the exponents leave.
        let rest = |f: &LinearFrame| {
            let explained: f64 = exponents.iter().map(|&c| f.gram[(GAIN, c)] * law.coefficient(c)[0]).sum();
            LinearFrame {
                gram: nalgebra::DMatrix::from_element(1, 1, f.gram[(GAIN, GAIN)]),
                right: nalgebra::DVector::from_element(1, f.right[GAIN] - explained),
            }
        };
        let rest: Vec<LinearFrame> = which.iter().map(|&f| rest(&self.sums[f])).collect();
        let factor = fit(&rest.iter().collect::<Vec<_>>(), &blocks, &[0], &[0.0]);
        // The exponents' errors move the factor by the means of their columns.
        let mean = |c: usize| {
            let sum = |j: usize| which.iter().map(|&f| self.sums[f].gram[(GAIN, j)]).sum::<f64>();
            sum(c) / sum(GAIN).max(1e-12)
        };
        let of_exponents: f64 = exponents.iter().map(|&c| (mean(c) * law.coefficient(c)[1]).powi(2)).sum();
        law.gain = [factor.theta[0], factor.error(0).hypot(of_exponents.sqrt()).hypot(self.of_rows)];
        law
    }

    /// Gains of the held-out frames by a law, nats.
    pub(super) fn gains_of(&self, law: &Law) -> Vec<f64> {
        let theta = |c: usize| if c == GAIN { law.gain[0] } else { law.coefficient(c)[0] };
        let columns: Vec<usize> = [GAIN].into_iter().chain(law.exponents.iter().copied()).collect();
        let theta = nalgebra::DVector::from_fn(columns.len(), |i, _| theta(columns[i]));
        let covariance = nalgebra::DMatrix::zeros(columns.len(), columns.len());
        let whole = LinearFit { columns, theta, covariance };
        self.hold_out.iter().map(|&i| whole.gain(&self.sums[i])).collect()
    }

    /// The finding of a law.
    pub(super) fn law_found(&self, law: &Law, held_out_gains: Vec<f64>) -> Found {
        // The true law may have another form: half of the smallest effect that is reported.
        let with_form = |c: usize| {
            let [value, error] = law.coefficient(c);
            let of_form = if value == 0.0 { 0.0 } else { 0.5 * EXPONENT_LN / self.spread(&self.estimate, c).max(0.1) };
            [value, error.hypot(of_form)]
        };
        let [range, cos, brightness] = [RANGE, COS, BRIGHTNESS].map(with_form);
        // ln I' = gain + gamma ln I + ..., with the logarithm counted from its mean in the fit.
        let ln_gain = law.gain[0] - brightness[0] * self.scale.centre;
        let ln_error = law.gain[1].hypot(0.5 * GAIN_LN).hypot(self.scale.centre * brightness[1]);
        let gain = ln_gain.exp();
        let with_bounds =
            |estimate: f64, low: f64, high: f64| Parameter { estimate, unit: Quantity::Gain.unit(), ci95: [low, high] };
        let gain_of = with_bounds(gain, (ln_gain - 1.96 * ln_error).exp(), (ln_gain + 1.96 * ln_error).exp());
        let parameters = vec![
            (Quantity::Gain.into(), gain_of),
            parameter(Quantity::RangeExponent, -range[0], range[1]),
            parameter(Quantity::IncidenceExponent, cos[0], cos[1]),
            parameter(Quantity::Gamma, 1.0 + brightness[0], brightness[1]),
        ];
        let round = |v: f64| crate::effects::rounded(v, 7);
        let column = self.scale.columns[0];
        let effect = IntensityResponse {
            gain: round(gain),
            gamma: round((1.0 + brightness[0]).max(0.0)),
            reference_m: REFERENCE_M,
            range_exponent: round(-range[0]),
            incidence_exponent: round(cos[0]),
            most: column.most,
            step: round(column.step),
        };
        let selected = Selected { rivals: vec![], confidence: 1.0 };
        Found {
            status: selected.status(),
            confidence: selected.confidence,
            causes: vec![Cause::IntensityLaw],
            parameters,
            channel: Channel::Intensity,
            covariate: Covariate::Range,
            held_out_gains,
            says: says(gain, -range[0], cos[0], 1.0 + brightness[0]),
            separate_by: None,
            curve: self.curve(),
            effects: vec![Effect::IntensityResponse(effect)],
        }
    }

    /// Geometric means of the ratio of intensities over range.
    fn curve(&self) -> Curve {
        let mut bins = std::collections::BTreeMap::<u32, [f64; 3]>::new();
        for ray in self.estimate.iter().flat_map(|&i| &self.context.frames[i].measured) {
            if let Some(y) = ln_ratio(ray) {
                let sum = bins.entry((f64::from(ray.range_m).max(1.0).ln() / 0.2) as u32).or_default();
                [1.0, y, y * y].iter().zip(sum).for_each(|(v, sum)| *sum += v);
            }
        }
        let point = |(bin, [n, y, yy]): (u32, [f64; 3])| {
            let (mean, measured) = (y / n, (y / n).exp());
            let error = measured * ((yy / n - mean * mean).max(0.0) / n).sqrt();
            let x = (0.2 * (f64::from(bin) + 0.5)).exp();
            CurvePoint { sensor: 0, x, measured, before: 1.0, after: measured, error }
        };
        Curve {
            x: "range, m".into(),
            y: "measured over simulated intensity".into(),
            by_sensor: false,
            points: bins.into_iter().filter(|(_, s)| s[0] >= 50.0).map(point).collect(),
        }
    }

    /// A note about reflectivities of the simulated world, beside these exponents.
    pub(super) fn world(&self, exponents: &[usize]) -> Option<String> {
        let law = self.law(&self.estimate, &Form { exponents: exponents.to_vec(), world: true });
        let says = |(column, name): (usize, &str)| {
            let at = law.shape.columns.iter().position(|c| *c == column)?;
            let (theta, error) = (law.shape.theta[at], law.shape.error(at));
            let seen = self.spread(&self.estimate, column) > 0.05;
            (seen && theta.abs() > 0.1 && theta.abs() > Z_STAR * error)
                .then(|| format!("{name} {:.0} %", 100.0 * (theta.exp() - 1.0)))
        };
        let found: Vec<String> =
            OF_THE_WORLD.into_iter().zip(["standing surfaces", "objects"]).filter_map(says).collect();
        (!found.is_empty()).then(|| {
            format!(
                "intensities beside those of the ground: {} brighter than simulated; these are reflectivities of the \
                 simulated world, no effect of the sensor",
                found.join(", ")
            )
        })
    }
}

/// A law in a sentence.
fn says(gain: f64, range: f64, incidence: f64, gamma: f64) -> String {
    let mut parts = vec![format!("{gain:.3}")];
    let times = |v: f64, of: &str| format!("{of}^{v:.2}");
    if gamma == 1.0 {
        parts.push("I".into())
    } else {
        parts.push(times(gamma, "I"))
    }
    if range != 0.0 {
        parts.push(times(range, &format!("({REFERENCE_M:.0} m / R)")));
    }
    if incidence != 0.0 {
        parts.push(times(incidence, "cos"));
    }
    format!("measured intensities are those of the simulation I as {}", parts.join(" "))
}
