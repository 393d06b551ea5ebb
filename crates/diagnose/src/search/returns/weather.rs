//! Whether lone returns come from droplets, and from which: their distribution over the free path of shots.

use crate::catalogue::Cause;
use crate::channels::free_path::{Bin, Fit, Fits, Shape, fit, fits};
use crate::pairing::FramePair;
use crate::search::first_demands;

/// Mean distance of droplets up to which lone returns come from them, and up to which they may come from them, as a
/// part of the range that holds nine tenths of the free paths: there, droplets are down to 13 % and 37 % of what they
/// are at the sensor. The threshold of a receiver may fall with time, and its noise with it, by some tens of per
/// cent.
const OF_VIEW: [f64; 2] = [0.5, 1.0];

/// Mean distances of droplets between which they may be single drops or fog, m. A drop of 2 mm returns as much light
/// as a surface of some per mille of the beam: it is seen up to 20 to 50 m, and on average at a quarter of that. Fog
/// in which the mean distance is less than the first one has a visibility of 50 m.
const SINGLE_DROPS_M: [f64; 2] = [8.0, 12.0];

/// Light of fog over its droplets: the extinction of light on its way there and back is at least this over the mean
/// distance of droplets. The bound is for optics that do not see what is near.
const LEAST_EXTINCTION: f64 = 0.35;

/// Ratio of the mean distance of droplets to that of a field of view that begins at the sensor, `1 / (2 alpha)`: the
/// interval of a visibility that only droplets tell.
const OPTICS: [f64; 2] = [0.8, 3.0];

/// Share of far returns that fog, or rain, loses at least, or at most, beyond what near ones lose.
const LOSES: [f64; 2] = [0.3, 0.05];

/// Fewest far simulated returns whose losses are counted.
const FEWEST: f64 = 500.0;

/// Droplets instead of false alarms.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Weather {
    /// Fog, rain, or both where they cannot be distinguished.
    pub(super) causes: Vec<Cause>,
    /// Law of ranges.
    pub(super) shape: Shape,
    /// Droplets for each shot.
    pub(super) rate: f64,
    /// Mean distance of droplets, m, and its interval.
    pub(super) depth_m: [f64; 3],
}

impl Weather {
    /// Visibility, m, with its interval: `alpha = ln(20) / visibility`.
    pub(super) fn visibility_m(&self) -> [f64; 3] {
        let [depth, low, high] = self.depth_m.map(|m| 2.0 * 20f64.ln() * m);
        [depth, low * OPTICS[0], high * OPTICS[1]]
    }
}

/// The weather that lone returns tell; `None` where they are spread evenly over the ranges. `lost` is
/// [`lost_with_range`] for a depth, `None` where it is not known.
pub(super) fn weather(bins: &[Bin], lost: impl Fn(f64) -> Option<f64>) -> Option<Weather> {
    let Fits { even, of_path, droplets } = fits(bins)?;
    let depth = droplets.shape.mean_m();
    let of_view = depth / view_m(bins);
    if droplets.nats - even.nats.max(of_path.nats) < first_demands().nats || of_view > OF_VIEW[1] {
        return None;
    }
    let causes = if of_view > OF_VIEW[0] {
        vec![Cause::Outliers, Cause::Fog]
    } else if depth > SINGLE_DROPS_M[1] {
        vec![Cause::Fog]
    } else {
        match lost(depth) {
            Some(lost) if lost < LOSES[1] && depth < SINGLE_DROPS_M[0] => vec![Cause::Rain],
            Some(lost) if lost > LOSES[0] => vec![Cause::Fog, Cause::Rain],
            _ => vec![Cause::Rain, Cause::Fog],
        }
    };
    let [low, high] = interval(bins, &droplets);
    Some(Weather { causes, shape: droplets.shape, rate: droplets.rate, depth_m: [depth, low, high] })
}

/// Range that holds nine tenths of the free paths, m.
fn view_m(bins: &[Bin]) -> f64 {
    let all: f64 = bins.iter().map(|b| b.free_m).sum();
    let mut nearer = 0.0;
    let last = bins.iter().find(|b| {
        nearer += b.free_m;
        nearer >= 0.9 * all
    });
    last.map_or(0.0, |b| b.ends_m[1])
}

/// Interval of the mean of a law: where the likelihood falls by two nats; at least 10 %.
fn interval(bins: &[Bin], best: &Fit) -> [f64; 2] {
    let falls = |factor: f64| {
        let other = |k: i32| best.shape.scaled(factor.powi(k));
        let likely = |k: &i32| best.nats - fit(other(*k), bins).nats < 2.0;
        other((1..60).take_while(likely).last().unwrap_or(0).max(5)).mean_m()
    };
    [falls(1.0 / 1.02), falls(1.02)]
}

/// Share of the simulated returns far beyond a depth that the measured side lacks, beyond the share of those nearer
/// than that; `None` with too few of either. Light that goes `n` depths through fog and back is weakened by at least
/// `exp(-0.35 n)`.
pub(super) fn lost_with_range(frames: &[&FramePair], depth_m: f64) -> Option<f64> {
    let beyond_m = (2.0 / LEAST_EXTINCTION * depth_m).max(25.0);
    let within_m = (2.0 * depth_m).max(12.0);
    let mut kept = [[0.0f64; 2]; 2];
    for ray in frames.iter().flat_map(|f| &f.simulated).filter(|r| r.smooth && r.cos_incidence > 0.2) {
        let range_m = f64::from(ray.range_m);
        let place = match range_m {
            r if r < within_m => 0,
            r if r > beyond_m => 1,
            _ => continue,
        };
        kept[place][0] += 1.0;
        kept[place][1] += f64::from(u8::from(ray.matched));
    }
    let [near, far] = kept.map(|[all, matched]| (all > FEWEST && matched > 0.0).then(|| matched / all));
    Some(1.0 - far? / near?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channels::free_path::bins;

    /// Bins of shots that are free up to 100 m, with lone returns of a density over range.
    fn of(density: impl Fn(f64) -> f64) -> Vec<Bin> {
        let mut bins = bins(&[], 100.0, &|_, _, _| false);
        for b in &mut bins {
            b.free_m = 300_000.0 * (b.ends_m[1] - b.ends_m[0]);
            b.of_path = b.free_m / 100.0;
            b.simulated = 1e-6 * b.free_m;
            b.measured = b.simulated + b.free_m * density((b.ends_m[0] + b.ends_m[1]) / 2.0);
        }
        bins
    }

    #[test]
    fn even_returns_are_no_weather_also_where_the_threshold_falls() {
        assert_eq!(weather(&of(|_| 1e-4), |_| None), None);
        assert_eq!(weather(&of(|r| 1e-4 * (1.0 - 0.003 * r)), |_| None), None);
    }

    #[test]
    fn fog_reaches_far_and_rain_is_near_and_leaves_far_returns() {
        let exponential = |mean: f64| of(move |r| 0.01 / mean * (-r / mean).exp());
        let fog = weather(&exponential(25.0), |_| None).unwrap();
        assert_eq!(fog.causes, [Cause::Fog]);
        assert!((fog.rate / 0.01 - 1.0).abs() < 0.1 && (fog.depth_m[0] / 25.0 - 1.0).abs() < 0.1, "{fog:?}");
        let [visibility, low, high] = fog.visibility_m();
        assert!((visibility / 150.0 - 1.0).abs() < 0.1 && low < visibility && visibility < high);
        let near = |lost: Option<f64>| weather(&exponential(5.0), |_| lost).unwrap().causes;
        assert_eq!(near(Some(0.01)), [Cause::Rain]);
        assert_eq!(near(Some(0.8)), [Cause::Fog, Cause::Rain]);
        assert_eq!(near(None), [Cause::Rain, Cause::Fog]);
    }
}
