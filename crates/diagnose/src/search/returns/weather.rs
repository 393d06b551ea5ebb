//! Whether lone returns come from droplets, and from which: their distribution over the free path of shots.

use super::ONE_SIDED;
use crate::catalogue::Cause;
use crate::channels::free_path::{Bin, bins};
use crate::channels::range_laws::{Fall, Origin, Shape};
use crate::channels::range_mixture::{Mixture, Part, instead, mixture, steady_instead};
use crate::channels::returns::{OWN_CAR_M, Odd, odd};
use crate::channels::together::crowding;
use crate::pairing::FramePair;
use crate::search::{Z_STAR, first_demands};

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

/// Relative variance of the number of lone returns over patches of directions from which on they do not come by chance:
/// that of one half of the patches with three times as many as the other half.
const CROWDED: f64 = 0.25;

/// Some returns: by the number of the frame, the side (0 measured) and their place there.
type Which<'a> = &'a (dyn Fn(usize, usize, usize) -> bool + Sync);

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

/// Lone returns in front of surfaces and in the open: where they come from.
#[derive(Clone, Debug, Default)]
pub(super) struct Air {
    bins: Vec<Bin>,
    /// What they come from.
    pub(super) mixture: Mixture,
    /// Whether those of each part come at some ranges alone, or in some directions of a frame, others from frame to
    /// frame.
    pub(super) crowds: Vec<bool>,
}

impl Air {
    /// Of some frames, up to `end_m`, without those that are left out; see [`bins`].
    pub(super) fn new(frames: &[&FramePair], end_m: f64, leave_out: Which) -> Air {
        let bins = bins(frames, end_m, leave_out);
        let mixture = mixture(&bins, first_demands().nats);
        let mut air = Air { bins, mixture, crowds: vec![] };
        let crowd = |place: usize| {
            air.mixture.parts[place].shape.origin() == Origin::Others || air.crowd(place, frames, leave_out)
        };
        air.crowds = (0..air.mixture.parts.len()).map(crowd).collect();
        air
    }

    /// Whether the returns of one part come in some directions, where it has the most of all returns.
    fn crowd(&self, place: usize, frames: &[&FramePair], leave_out: Which) -> bool {
        let shares = self.mixture.shares_by_bin(place, &self.bins);
        let most = shares.iter().copied().fold(0.0, f64::max);
        let inside = |range_m: f64| {
            let at = self.bins.iter().position(|b| (b.ends_m[0]..b.ends_m[1]).contains(&range_m));
            at.is_some_and(|k| shares[k] > 0.5 * most)
        };
        let counts = |f: usize, i: usize| {
            let ray = &frames[f].measured[i];
            odd(ray) == Some(Odd::Alone) && inside(ray.own_range_m()) && !leave_out(f, 0, i)
        };
        let [variance, error] = crowding(frames, &counts);
        variance - Z_STAR * error > CROWDED
    }

    /// Share of the returns that each part of the mixture has.
    pub(super) fn shares(&self) -> Vec<f64> {
        self.mixture.shares(&self.bins, 0.0)
    }

    /// Share in the returns beyond the ego vehicle of those that come from the receiver, or from the light of others;
    /// `None` where there are none.
    pub(super) fn of_receiver(&self) -> Option<f64> {
        let shares = self.mixture.shares(&self.bins, OWN_CAR_M);
        let places = self.of_receiver_at();
        (!places.is_empty()).then(|| places.iter().map(|&k| shares[k]).sum())
    }

    /// Whether a part is noise of the receiver.
    pub(super) fn is_of_receiver(&self, place: usize) -> bool {
        self.mixture.parts[place].shape.origin() == Origin::Receiver
    }

    /// Places of the parts that come from the receiver, or from the light of others.
    fn of_receiver_at(&self) -> Vec<usize> {
        (0..self.mixture.parts.len()).filter(|&k| self.crowds[k] || self.is_of_receiver(k)).collect()
    }

    /// Whether there are far more lone returns behind surfaces than what comes from the receiver: its noise, and the
    /// light of others, come at any time, behind surfaces as often as before them.
    pub(super) fn mostly_behind(&self) -> bool {
        let seen: f64 = self.bins.iter().map(excess_behind).sum();
        let places = self.of_receiver_at();
        let expected = if places.is_empty() { self.before_and_behind() } else { self.expected_behind(&places) };
        seen > ONE_SIDED * expected
    }

    /// Returns of some parts that are expected behind surfaces.
    fn expected_behind(&self, places: &[usize]) -> f64 {
        let of_part = |&place: &usize| {
            let before = self.mixture.returns_by_bin(place, &self.bins);
            before.iter().zip(&self.bins).map(|(n, bin)| n / bin.free_m.max(1.0) * bin.behind_m).sum::<f64>()
        };
        places.iter().map(of_part).sum()
    }

    /// Returns behind surfaces that would be there if all those before surfaces came from the receiver, whatever their
    /// ranges; none where less than half of them are.
    pub(super) fn before_and_behind(&self) -> f64 {
        let expected = |b: &Bin| (b.measured - b.simulated).max(0.0) / b.free_m.max(1.0) * b.behind_m;
        let all: f64 = self.bins.iter().map(expected).sum();
        let both: f64 = self.bins.iter().map(|b| expected(b).min(excess_behind(b))).sum();
        if both > 0.5 * all { all } else { 0.0 }
    }

    /// Reach of false alarms beside droplets, m; `None` where there are no droplets, or no reach is known.
    pub(super) fn reach_m(&self) -> Option<f64> {
        let shape = self.mixture.parts[self.mixture.place(Origin::Receiver)?].shape;
        match shape {
            Shape::Even(reach_m, _) if self.mixture.parts.len() > 1 => Some(reach_m),
            _ => None,
        }
    }

    /// The weather that one part of the mixture tells; `None` where it is of the receiver. `lost` is
    /// [`lost_with_range`] for a depth, `None` where it is not known.
    pub(super) fn weather(&self, place: usize, lost: impl Fn(f64) -> Option<f64>) -> Option<Weather> {
        let part = self.mixture.parts[place];
        match part.shape {
            Shape::OfPath | Shape::Even(_, Fall::No) | Shape::Band(..) => None,
            Shape::Even(..) => self.fog_beyond_the_view(place),
            Shape::Exponential(_) | Shape::Gamma(_) | Shape::Drops(_) => {
                let causes = self.droplets(place, lost);
                Some(weather(causes, part, interval(&self.bins, &self.mixture, place)))
            }
        }
    }

    /// What droplets a part of the mixture is of.
    fn droplets(&self, place: usize, lost: impl Fn(f64) -> Option<f64>) -> Vec<Cause> {
        let shape = self.mixture.parts[place].shape;
        let depth = shape.mean_m();
        let likely = |other: Origin| {
            self.mixture.nats - instead(&self.mixture, place, other, &self.bins).nats < first_demands().nats
        };
        if depth > SINGLE_DROPS_M[1] {
            let noise = self.mixture.place(Origin::Receiver).is_none() && likely(Origin::Receiver);
            return if noise { vec![Cause::Fog, Cause::Outliers] } else { vec![Cause::Fog] };
        }
        let are_drops = shape.origin() == Origin::Drops;
        let other = if are_drops { Origin::Droplets } else { Origin::Drops };
        let by_law = !likely(other);
        let beside_fog = self.mixture.place(Origin::Droplets).is_some();
        match lost(depth) {
            // What is lost far away may be the fog's.
            _ if are_drops && by_law && beside_fog => vec![Cause::Rain],
            Some(lost) if lost < LOSES[1] && depth < SINGLE_DROPS_M[0] => vec![Cause::Rain],
            Some(lost) if lost > LOSES[0] => vec![Cause::Fog, Cause::Rain],
            _ if are_drops && by_law => vec![Cause::Rain],
            _ if by_law && depth > SINGLE_DROPS_M[0] => vec![Cause::Fog],
            _ => vec![Cause::Rain, Cause::Fog],
        }
    }

    /// Fog that is as likely as false alarms that fall with range, where those that do not are less likely.
    fn fog_beyond_the_view(&self, place: usize) -> Option<Weather> {
        let fog = instead(&self.mixture, place, Origin::Droplets, &self.bins);
        let part = *fog.parts.get(place)?;
        let demanded = first_demands().nats;
        let likely = fog.nats > self.mixture.nats - demanded
            && fog.nats > steady_instead(&self.mixture, place, &self.bins).nats + demanded
            && part.shape.mean_m() < view_m(&self.bins);
        likely.then(|| weather(vec![Cause::Outliers, Cause::Fog], part, interval(&self.bins, &fog, place)))
    }
}

/// Measured lone returns behind surfaces beyond the simulated ones.
fn excess_behind(bin: &Bin) -> f64 {
    (bin.behind[0] - bin.behind[1]).max(0.0)
}

/// Droplets of some causes.
fn weather(causes: Vec<Cause>, Part { shape, rate }: Part, [low, high]: [f64; 2]) -> Weather {
    Weather { causes, shape, rate, depth_m: [shape.mean_m(), low, high] }
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

/// Interval of the mean of one part of a mixture: where the likelihood falls by two nats; at least 10 %.
fn interval(bins: &[Bin], mixture: &Mixture, place: usize) -> [f64; 2] {
    let shape = mixture.parts[place].shape;
    let falls = |factor: f64| {
        let other = |k: i32| shape.scaled(factor.powi(k));
        let likely = |k: &i32| mixture.nats - mixture.likeliest(place, [other(*k)], bins).nats < 2.0;
        other((1..60).take_while(likely).last().unwrap_or(0).max(5)).mean_m()
    };
    [falls(1.0 / 1.02), falls(1.02)]
}

/// Share of the simulated returns far beyond a depth that the measured side lacks, beyond the share of those nearer
/// than that; `None` with too few of either. Light that goes `n` depths through fog and back is weakened by at least
/// `exp(-0.35 n)`. Returns beyond the range of the measured side, in which all but 1 % of its returns are, do not
/// count: a sensor may have an end.
pub(super) fn lost_with_range(frames: &[&FramePair], depth_m: f64) -> Option<f64> {
    let beyond_m = (2.0 / LEAST_EXTINCTION * depth_m).max(25.0);
    let within_m = (2.0 * depth_m).max(12.0);
    let end_m = end_of_range(frames);
    let mut kept = [[0.0f64; 2]; 2];
    for ray in frames.iter().flat_map(|f| &f.simulated).filter(|r| r.smooth && r.cos_incidence > 0.2) {
        let range_m = f64::from(ray.range_m);
        let place = match range_m {
            r if r < within_m => 0,
            r if r > beyond_m && r < end_m => 1,
            _ => continue,
        };
        kept[place][0] += 1.0;
        kept[place][1] += f64::from(u8::from(ray.matched));
    }
    let [near, far] = kept.map(|[all, matched]| (all > FEWEST && matched > 0.0).then(|| matched / all));
    Some(1.0 - far? / near?)
}

/// Range in which 99 % of the simulated returns are that the measured side has as well, m.
fn end_of_range(frames: &[&FramePair]) -> f64 {
    let matched = frames.iter().flat_map(|f| &f.simulated).filter(|r| r.matched);
    let mut ranges: Vec<f64> = matched.map(|r| f64::from(r.range_m)).collect();
    let last = ranges.len() * 99 / 100;
    if ranges.is_empty() { 0.0 } else { *ranges.select_nth_unstable_by(last, f64::total_cmp).1 }
}

#[cfg(test)]
mod tests {
    use super::*;

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

    /// The weather of the only part of what is most likely.
    fn alone(bins: &[Bin], lost: Option<f64>) -> Option<Weather> {
        let mixture = mixture(bins, first_demands().nats);
        let air = Air { mixture, bins: bins.to_vec(), crowds: vec![] };
        assert_eq!(air.mixture.parts.len(), 1, "{air:?}");
        air.weather(0, |_| lost)
    }

    #[test]
    fn even_returns_are_no_weather_also_where_the_threshold_falls() {
        assert_eq!(alone(&of(|_| 1e-4), None), None);
        assert_eq!(alone(&of(|r| 1e-4 * (1.0 - 0.003 * r)), None), None);
    }

    #[test]
    fn fog_reaches_far_and_rain_is_near_and_leaves_far_returns() {
        let exponential = |mean: f64| of(move |r| 0.01 / mean * (-r / mean).exp());
        let gamma = |mean: f64| of(move |r| 0.04 / mean / mean * r * (-2.0 * r / mean).exp());
        let fog = alone(&exponential(25.0), None).unwrap();
        assert_eq!(fog.causes, [Cause::Fog]);
        assert!((fog.rate / 0.01 - 1.0).abs() < 0.1 && (fog.depth_m[0] / 25.0 - 1.0).abs() < 0.1, "{fog:?}");
        let [visibility, low, high] = fog.visibility_m();
        assert!((visibility / 150.0 - 1.0).abs() < 0.1 && low < visibility && visibility < high);
        let near = |lost: Option<f64>| alone(&exponential(5.0), lost).unwrap().causes;
        assert_eq!(near(Some(0.01)), [Cause::Rain]);
        assert_eq!(near(Some(0.8)), [Cause::Fog, Cause::Rain]);
        assert_eq!(near(None), [Cause::Rain, Cause::Fog]);
        // Fog of which nothing is seen at the sensor has another law than single drops, also far away.
        assert_eq!(alone(&gamma(10.0), Some(0.1)).unwrap().causes, [Cause::Fog]);
        assert_eq!(alone(&gamma(60.0), None).unwrap().causes, [Cause::Fog]);
    }

    #[test]
    fn droplets_are_before_surfaces_alone_and_noise_is_behind_them_as_well() {
        // As many metres of shots behind surfaces as before them, with a number of returns there.
        let mostly_behind = |before: &[Bin], behind: f64| {
            let all: f64 = before.iter().map(|b| b.free_m).sum();
            let with = |b: &Bin| Bin { behind: [behind * b.free_m / all, 0.0], behind_m: b.free_m, ..*b };
            let bins: Vec<Bin> = before.iter().map(with).collect();
            let mixture = mixture(&bins, first_demands().nats);
            Air { crowds: vec![false; mixture.parts.len()], mixture, bins }.mostly_behind()
        };
        let noise = of(|_| 1e-4);
        assert!(!mostly_behind(&noise, 3000.0) && mostly_behind(&noise, 30_000.0));
        let rain = of(|r| if r < 22.0 { 3e-3 / r } else { 0.0 });
        assert!(mostly_behind(&rain, 1000.0));
        assert!(!mostly_behind(&of(|_| 0.0), 0.0));
    }
}
