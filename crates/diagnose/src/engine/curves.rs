//! The plots of findings with the extended simulation, measured on the frames that were made anew with it.
//!
//! Along the covariate of a plot, the difference between the two sides is summed in the same way on the pair as it was
//! recorded and on the pair with the extended simulation. What is gone of it is the share of the way that the curve of
//! the simulation moves towards the measured one.

use crate::catalogue::{Channel, Covariate};
use crate::channels::returns::odd;
use crate::channels::roughness::own_roughness_m;
use crate::curve::Curve;
use crate::diagnosis::Finding;
use crate::pairing::{FramePair, Ray};
use sensor::signal::index_offset;
use statistics::median_upper;

/// Fewest returns of either side of a point for a share of its own.
const FEWEST: usize = 50;

/// Smallest difference of a point, of the largest one of its curve, for a share of its own.
const LEAST_OF_LARGEST: f64 = 0.05;

/// Gives the curve of a finding its values with the extended simulation. `recorded` and `extended` are frames of the
/// pair as it was and of the pair with the extended simulation; `closed` is the share of the channel that is gone.
pub(super) fn measure(finding: &mut Finding, recorded: &[&FramePair], extended: &[FramePair], closed: f64) {
    let extended: Vec<&FramePair> = extended.iter().collect();
    let before = differences(finding, recorded);
    let after = differences(finding, &extended);
    let largest = before.iter().flatten().map(|d| d.abs()).fold(0.0, f64::max);
    for ((point, before), after) in finding.curve.points.iter_mut().zip(before).zip(after) {
        let own = match (before, after) {
            (Some(before), Some(after)) if before.abs() > LEAST_OF_LARGEST * largest => 1.0 - after / before,
            _ => closed,
        };
        point.after = point.before + own.clamp(-1.0, 2.0) * (point.measured - point.before);
        if matches!(finding.channel, Channel::Hits | Channel::Returns | Channel::Roughness) {
            point.after = point.after.max(0.0); // a share or a standard deviation
        }
    }
}

/// For each point of a finding's curve the difference of the measured from the simulated side; `None` with too few
/// returns, and where the difference is not one of single returns.
fn differences(finding: &Finding, frames: &[&FramePair]) -> Vec<Option<f64>> {
    let bins = Bins::new(&finding.curve);
    let mut values: [Vec<Vec<f64>>; 2] = [0, 1].map(|_| vec![Vec::new(); finding.curve.points.len()]);
    for frame in frames {
        for (side, rays) in [&frame.measured, &frame.simulated].into_iter().enumerate() {
            for ray in rays {
                if let Some((x, value)) = place_and_value(finding, ray)
                    && let Some(bin) = bins.of(usize::from(ray.sensor), x)
                {
                    values[side][bin].push(value);
                }
            }
        }
    }
    let [measured, simulated] = values;
    let median_of = finding.channel == Channel::Roughness;
    let middle = |values: Vec<f64>| match (values.len() < FEWEST, median_of) {
        (true, _) => None,
        (false, true) => median_upper(values.iter().map(|v| v.abs()).collect()).map(|v| v * v),
        (false, false) => Some(values.iter().sum::<f64>() / values.len() as f64),
    };
    measured.into_iter().zip(simulated).map(|(a, b)| Some(middle(a)? - middle(b)?)).collect()
}

/// Place of a return along a finding's curve, and what is compared there.
fn place_and_value(finding: &Finding, ray: &Ray) -> Option<(f64, f64)> {
    let value = match finding.channel {
        Channel::Hits => f64::from(u8::from(!ray.matched)),
        Channel::Roughness => own_roughness_m(ray)?,
        Channel::Intensity => crate::channels::intensity::ln_ratio(ray)?,
        Channel::Residuals if ray.smooth => f64::from(ray.residual_m),
        Channel::Returns => f64::from(u8::from(odd(ray).is_some())),
        _ => return None,
    };
    let (range, cos) = (f64::from(ray.range_m), f64::from(ray.cos_incidence));
    let place = match finding.covariate {
        Covariate::Row => (ray.row != u16::MAX).then_some(f64::from(ray.row)),
        Covariate::Azimuth | Covariate::Direction | Covariate::Sensor => Some(f64::from(ray.azimuth_rad).to_degrees()),
        Covariate::CosIncidence if finding.channel == Channel::Hits => {
            (cos > 0.0).then(|| cos.min(1.0).asin().to_degrees())
        }
        Covariate::Signal if finding.channel == Channel::Hits => {
            (cos > 0.0).then(|| cos.ln() - 2.0 * range.ln() + index_offset())
        }
        // Those of the frame, and what the search alone knows of intensities: a ray does not say.
        Covariate::Time | Covariate::Velocity | Covariate::Brightness => None,
        Covariate::RangeTanIncidence => (cos > 0.0).then(|| range * (1.0 / (cos * cos) - 1.0).max(0.0).sqrt()),
        _ => Some(range),
    };
    Some((place?, value))
}

/// The points of a curve as bins: a value belongs to the nearest point of its sensor.
struct Bins {
    /// Place, sensor and number of each point, ascending by sensor and place.
    points: Vec<(usize, f64, usize)>,
    by_sensor: bool,
}

impl Bins {
    fn new(curve: &Curve) -> Bins {
        let mut points: Vec<(usize, f64, usize)> =
            curve.points.iter().enumerate().map(|(i, p)| (p.sensor, p.x, i)).collect();
        points.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
        Bins { points, by_sensor: curve.by_sensor }
    }

    fn of(&self, sensor: usize, x: f64) -> Option<usize> {
        let sensor = if self.by_sensor { sensor } else { 0 };
        let from = self.points.partition_point(|p| p.0 < sensor);
        let own = &self.points[from..self.points.partition_point(|p| p.0 <= sensor)];
        let at = own.partition_point(|p| p.1 < x);
        let near = [at.checked_sub(1), Some(at)].into_iter().flatten().filter_map(|i| own.get(i));
        near.min_by(|a, b| (a.1 - x).abs().total_cmp(&(b.1 - x).abs())).map(|p| p.2)
    }
}
