//! Findings of noise: parameters, sentences and plots.

use super::Term;
use super::curve::curve;
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::diagnosis::Status;
use crate::inference::linear::LinearFit;
use crate::inference::noise::{NoiseLaw, NoiseTable};
use crate::search::{Found, NamedParameter, Selected, parameter};

/// What recording tells laws of noise.
const TELL_BY_INCIDENCE: &str =
    "surfaces at normal and at grazing incidence at the same range (a wall or a board beside the road, near and far)";

/// What recording tells scattering directions from wide beams.
const TELL_BY_EDGES: &str =
    "upright edges (posts, corners of houses) before something farther: directions that scatter make them ragged";

/// The finding of law `k` of those that were fitted together, with the causes that have this law.
pub(super) fn found(
    fitted: &LinearFit,
    k: usize,
    (mut causes, selected): (Vec<Cause>, Selected),
    held_out_gains: Vec<f64>,
    table: &NoiseTable,
    terms: &[Term],
) -> Found {
    let (law, theta) = (terms[k].0, fitted.theta[k]);
    let sigma = theta.signum() * theta.abs().sqrt();
    // The true law may have another form: three per cent of the value.
    let error = (fitted.error(k) / (2.0 * theta.abs().sqrt()).max(1e-9)).hypot(0.03 * sigma);
    let by_edges = causes.len() > 1;
    causes.extend(selected.rivals);
    let separate_by = (causes.len() > 1).then(|| if by_edges { TELL_BY_EDGES } else { TELL_BY_INCIDENCE }.to_owned());
    Found {
        effects: Vec::new(),
        status: if causes.len() > 1 { Status::Ambiguous } else { Status::Named },
        confidence: selected.confidence,
        parameters: parameters(law, causes[0], sigma, error),
        channel: Channel::Roughness,
        covariate: covariate(law),
        held_out_gains,
        says: says(law, causes[0], sigma),
        causes,
        separate_by,
        curve: curve(table, law, terms),
    }
}

/// Parameters of a law with a standard deviation `sigma`, m or rad, negative where the measured side has less noise.
fn parameters(law: NoiseLaw, cause: Cause, sigma: f64, error: f64) -> Vec<NamedParameter> {
    match law {
        NoiseLaw::Constant => {
            vec![parameter(Quantity::StdM, sigma, error), parameter(Quantity::PerM, 0.0, 1e-4)]
        }
        NoiseLaw::Growing(g) => vec![
            parameter(Quantity::StdM, sigma, error.hypot(0.15 * sigma)),
            parameter(Quantity::PerM, g * sigma, 0.3 * g * sigma),
        ],
        NoiseLaw::Signal(gamma) => vec![
            parameter(Quantity::StdM, sigma, error.hypot(0.1 * sigma)),
            parameter(Quantity::Exponent, 0.5 * gamma, 0.15 * gamma),
        ],
        NoiseLaw::Angular if cause == Cause::IncidenceNoise => vec![parameter(Quantity::AngleRad, sigma, error)],
        NoiseLaw::Angular => vec![parameter(Quantity::StdDeg, sigma.to_degrees(), error.to_degrees())],
    }
}

/// What a law depends on.
fn covariate(law: NoiseLaw) -> Covariate {
    match law {
        NoiseLaw::Constant => Covariate::None,
        NoiseLaw::Growing(_) => Covariate::Range,
        NoiseLaw::Signal(_) => Covariate::Signal,
        NoiseLaw::Angular => Covariate::RangeTanIncidence,
    }
}

/// The finding in a sentence.
fn says(law: NoiseLaw, cause: Cause, sigma: f64) -> String {
    match law {
        NoiseLaw::Constant => {
            format!("measured ranges scatter by {:.1} cm more than simulated ones, everywhere alike", sigma * 100.0)
        }
        NoiseLaw::Growing(g) => {
            let at = |r: f64| sigma * (1.0 + g * r) * 100.0;
            format!(
                "measured ranges scatter more than simulated ones, and more with range: by {:.1} cm at 10 m, {:.1} cm at 50 m",
                at(10.0),
                at(50.0)
            )
        }
        NoiseLaw::Signal(_) => {
            format!("measured ranges scatter more where the signal is weak: by {:.1} cm at u = 4", sigma * 100.0)
        }
        NoiseLaw::Angular if cause == Cause::IncidenceNoise => format!(
            "measured ranges scatter more at grazing incidence, as {:.2} mrad of a beam do there, and edges stay as \
             straight as simulated ones",
            1e3 * sigma
        ),
        NoiseLaw::Angular => format!(
            "beams deviate by {:.3} degrees from the directions that the sensor reports: ranges scatter at grazing incidence and not at normal incidence",
            sigma.to_degrees()
        ),
    }
}
