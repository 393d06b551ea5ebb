//! Lost packets: of shots that a sensor sends one after the other no return arrives in one scan, and in other scans the
//! same shots have returns.

mod runs;

use self::runs::Runs;
use super::{ChannelResult, Context, Found, sensor_number, with_error};
use crate::catalogue::sizes::PACKETS_SHARE;
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Considered, Minimum, Parameter, Status};
use crate::inference::choice::total_and_z;
use crate::inference::counts::gain_of_count;
use crate::inference::roles::Role;
use crate::pairing::{FramePair, Ray};
use rayon::prelude::*;
use sensor::directions::{ScanPattern, Sensors};
use sensor::rig::Sweep;
use std::collections::{BTreeMap, BTreeSet};

/// Smallest width of a bin of azimuth, rad: half a degree. Packets of rotating sensors cover one to five degrees.
const BIN_RAD: f64 = 0.0087;

/// Width of a bin in steps between columns, at least, so that every bin has a column; and of a sensor that scans row
/// by row, so that every bin has enough shots.
const BIN_STEPS: [f64; 2] = [1.5, 12.0];

/// Fewest simulated returns of a bin that is judged: by chance half of the returns would not all be lost.
const FEWEST: f64 = 8.0;

/// Share of the expected returns of a bin below which all are lost; the rest are false alarms.
const DARK: f64 = 0.1;

/// Share of the returns that is expected in a bin, by their ranges and by the same bin in other scans, from which on
/// the bin is not dark for another reason.
const USUALLY_SEEN: f64 = 0.5;

/// Fewest dark bins, and fewest runs of them of one sensor. That all returns of many shots in a row are lost by chance
/// is as good as impossible; a single run may be a frame that was cut off.
const FEWEST_DARK: [usize; 2] = [5, 2];

/// Largest ratio of dark bins of the other side: these are things that one side lacks.
const OTHER_SIDE: f64 = 0.2;

/// Largest ratio of dim bins, which lose most returns and not all: other losses make bins of all shades, packets dark
/// ones alone.
const DIM_BINS: f64 = 0.5;

/// Share of the expected returns of a bin below which it is dim.
const DIM: f64 = 0.35;

/// Factor by which the loss of a return is less likely without packets.
const SURPRISE: f64 = 20.0;

/// Sensor and number of a bin of the time within a scan.
type Bin = (u8, i32);

/// How the shots of a sensor follow each other. Times are shares of a scan.
#[derive(Clone, Copy, Debug)]
struct Order {
    /// Width of a bin.
    width: f64,
    fov_rad: f64,
    /// Number of rows of a sensor that scans row by row; else 1.
    rows: f64,
}

impl Order {
    /// Of every sensor. Without a pattern in the rig columns are taken to follow each other, as with a spinning sensor.
    /// `None` where rows are not known: what is beside each other was not sent one after the other.
    fn of_sensors(context: &Context, sensors: &Sensors) -> Vec<Option<Order>> {
        let of_sensor = |(sensor, found): (&sensor::Sensor, &ScanPattern)| {
            let fov_rad = 2.0 * sensor.half_fov_rad();
            let step = f64::from(found.steps.azimuth_rad) / fov_rad;
            let by_row = sensor.pattern.as_ref().is_some_and(|p| p.sweep == Sweep::Rows);
            let (width, rows) = match (by_row, found.rows_rad.len() as f64) {
                (true, rows) => (BIN_STEPS[1] * step / rows, rows),
                (false, _) => ((BIN_RAD / fov_rad).max(BIN_STEPS[0] * step), 1.0),
            };
            (!found.rows_rad.is_empty()).then_some(Order { width, fov_rad, rows })
        };
        context.rig.sensors.iter().zip(&sensors.patterns).map(of_sensor).collect()
    }

    /// The bin of a ray.
    fn bin(&self, ray: &Ray) -> i32 {
        let along = (0.5 - f64::from(ray.azimuth_rad) / self.fov_rad).clamp(0.0, 1.0);
        let above = if self.rows > 1.0 { self.rows - 1.0 - f64::from(ray.row) } else { 0.0 };
        ((above + along) / self.rows / self.width).floor() as i32
    }
}

/// Returns of one side of a frame by bin: all, those with a counterpart, and how many of them would have one by their
/// ranges.
type Counts = BTreeMap<Bin, [f64; 3]>;

/// The dark bins of every frame, and the counts of all bins.
struct Dark(Vec<BTreeSet<Bin>>, Vec<Counts>);

impl Dark {
    fn new(counts: Vec<Counts>, other: &[Counts]) -> Self {
        Dark(bins_below(DARK, &counts, other), counts)
    }
}

/// What is lost in all frames.
pub struct Packets {
    orders: Vec<Option<Order>>,
    /// Of the simulated returns, those that are not measured; and of the measured returns those that are not simulated.
    sides: [Dark; 2],
}

impl Packets {
    /// Of all frames.
    pub fn new(context: &Context, sensors: &Sensors) -> Self {
        let orders = Order::of_sensors(context, sensors);
        let sides: [fn(&FramePair) -> &[Ray]; 2] = [|f| &f.simulated, |f| &f.measured];
        let [simulated, measured] = sides.map(|side| {
            let usual = shares_by_range(context.frames, side);
            let of_frame = |f: &FramePair| counts(side(f), &orders, &usual);
            let all: Vec<Counts> = context.frames.par_iter().map(of_frame).collect();
            all
        });
        let lacking = Dark::new(measured, &simulated);
        Packets { orders, sides: [Dark::new(simulated, &lacking.1), lacking] }
    }

    /// The frames without the rays of packets that either side lost, and of the bins beside them, which are lost in
    /// part; `None` where no packet was lost.
    pub fn arrived(&self, frames: &[FramePair]) -> Option<Vec<FramePair>> {
        let [Dark(a, _), Dark(b, _)] = &self.sides;
        let of_frame = |(frame, lost): (&FramePair, [&BTreeSet<Bin>; 2])| {
            let stays = |ray: &Ray| {
                let Some((sensor, bin)) = bin_of(ray, &self.orders) else { return true };
                (-1..=1).all(|k| lost.iter().all(|lost| !lost.contains(&(sensor, bin + k))))
            };
            let mut frame = frame.clone();
            frame.measured.retain(&stays);
            frame.only_measured.retain(&stays);
            frame.simulated.retain(&stays);
            frame
        };
        let any = a.iter().chain(b).any(|lost| !lost.is_empty());
        any.then(|| frames.par_iter().zip(a.par_iter().zip(b)).map(|(f, (a, b))| of_frame((f, [a, b]))).collect())
    }

    /// Bins of some frames that lose most of the returns and not all, but for those beside dark ones: a packet covers a
    /// part of these.
    fn dim(&self, frames: &[usize]) -> usize {
        let [Dark(dark, counts), Dark(_, other)] = &self.sides;
        let dim = bins_below(DIM, counts, other);
        let alone = |i: usize, (sensor, bin): Bin| (-1..=1).all(|k| !dark[i].contains(&(sensor, bin + k)));
        frames.iter().map(|&i| dim[i].iter().filter(|bin| alone(i, **bin)).count()).sum()
    }

    /// Gains of the `test` frames by the share of dark bins of the `train` frames over that of the other side, nats.
    pub fn by_table(&self, train: &[usize], test: &[usize]) -> Vec<f64> {
        let number = |Dark(dark, counts): &Dark, i: usize| [dark[i].len() as f64, counts[i].len() as f64];
        let [lost, lacking] = self.sides.each_ref().map(|side| {
            let [dark, all] = train.iter().map(|&i| number(side, i)).fold([0.0; 2], |s, n| [s[0] + n[0], s[1] + n[1]]);
            (dark + 0.5) / (all + 1.0)
        });
        let gain = |&i: &usize| {
            let [dark, all] = number(&self.sides[0], i);
            gain_of_count(dark, all, lost, lacking)
        };
        test.iter().map(gain).collect()
    }
}

/// The search; and the frames without what is lost, where either side loses packets.
pub fn search(context: &Context, sensors: &Sensors) -> (ChannelResult, Option<Vec<FramePair>>) {
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let mut result = ChannelResult::new(Channel::Packets, hold_out.len());
    let packets = Packets::new(context, sensors);
    let [dark, other] = &packets.sides;
    let returns = |i: usize, Dark(dark, counts): &Dark| dark[i].iter().map(|bin| counts[i][bin][0]).sum::<f64>();
    let share = |i: usize| {
        let all = (context.frames[i].simulated.len() as f64).max(1.0);
        (returns(i, dark) - returns(i, other)) / all
    };
    let differences = |of: &[usize]| of.iter().map(|&i| share(i)).collect::<Vec<f64>>();
    let (_, z) = total_and_z(&differences(&select));
    // Bursts are rare: those of the estimating frames count as well.
    let all = [select.as_slice(), &estimate].concat();
    let looked_at = || all.iter();
    let number = |of: &[BTreeSet<Bin>]| looked_at().map(|&i| of[i].len()).sum::<usize>();
    let runs = |of: &[BTreeSet<Bin>]| {
        let of_sensor = |sensor: u8| looked_at().map(|&i| runs_of(&of[i], sensor)).sum::<usize>();
        (0..context.rig.sensors.len() as u8).map(of_sensor).max().unwrap_or(0)
    };
    let loses = |side: &Dark| number(&side.0) >= FEWEST_DARK[0] && runs(&side.0) >= FEWEST_DARK[1];
    let mean = looked_at().map(|&i| share(i)).sum::<f64>() / looked_at().count().max(1) as f64;
    let chosen = loses(dark)
        && (number(&other.0) as f64) < OTHER_SIDE * number(&dark.0) as f64
        && (packets.dim(&all) as f64) < DIM_BINS * number(&dark.0) as f64
        && mean > PACKETS_SHARE;
    result.considered.push(Considered {
        cause: Cause::PacketLoss.into(),
        channel: Channel::Packets,
        nats_per_ray: 0.0,
        z,
        outcome: if chosen { "chosen" } else { "no shots in a row are lost in single scans" }.into(),
    });
    result.minimum.push((Cause::PacketLoss, Minimum::new(Quantity::Share, PACKETS_SHARE)));
    if !chosen {
        // What the simulation loses is nothing that the measured side has in addition.
        return (result, if loses(other) { packets.arrived(context.frames) } else { None });
    }
    let held: Vec<f64> = hold_out.iter().map(|&i| returns(i, dark) * SURPRISE.ln()).collect();
    result.distance.iter_mut().zip(&held).for_each(|(d, g)| *d = [*g; 3]);
    let each = differences(&all);
    let (total, z) = total_and_z(&each);
    let share = total / each.len().max(1) as f64;
    let widths: Vec<f64> = packets.orders.iter().map(|o| o.map_or(1.0, |o| o.width)).collect();
    let runs = Runs::new(&dark.0, &dark.1, &all, &widths);
    result.found.push(found(context, &runs, [share, share / z.max(1.0)], held));
    (result, packets.arrived(context.frames))
}

fn bin_of(ray: &Ray, orders: &[Option<Order>]) -> Option<Bin> {
    let order = orders[usize::from(ray.sensor)].filter(|_| ray.row != u16::MAX)?;
    Some((ray.sensor, order.bin(ray)))
}

/// Width of a bin of the logarithm of range.
const LN_RANGE: f64 = 0.1;

fn range_bin(ray: &Ray) -> i32 {
    (f64::from(ray.range_m).max(0.1).ln() / LN_RANGE).floor() as i32
}

/// Share of the returns at each range that have a counterpart: near and far ones may all be lost, which is no packet.
fn shares_by_range(frames: &[FramePair], side: impl Fn(&FramePair) -> &[Ray]) -> BTreeMap<i32, f64> {
    let mut sums = BTreeMap::<i32, [f64; 2]>::new();
    for ray in frames.iter().flat_map(side) {
        let [all, matched] = sums.entry(range_bin(ray)).or_default();
        (*all, *matched) = (*all + 1.0, *matched + f64::from(u8::from(ray.matched)));
    }
    sums.into_iter().map(|(bin, [all, matched])| (bin, matched / all)).collect()
}

fn counts(rays: &[Ray], orders: &[Option<Order>], usual: &BTreeMap<i32, f64>) -> Counts {
    let mut counts = Counts::new();
    for (ray, bin) in rays.iter().filter_map(|r| Some((r, bin_of(r, orders)?))) {
        let [all, matched, expected] = counts.entry(bin).or_default();
        *all += 1.0;
        *matched += f64::from(u8::from(ray.matched));
        *expected += usual.get(&range_bin(ray)).copied().unwrap_or(0.0);
    }
    counts.retain(|_, c| c[0] >= FEWEST);
    counts
}

/// Bins that lose all returns in a frame but for a share, and not in most of the others. The other side has no returns
/// there at all: where it has some, it shows another thing.
fn bins_below(share: f64, frames: &[Counts], other: &[Counts]) -> Vec<BTreeSet<Bin>> {
    let mut all = BTreeMap::<Bin, [f64; 2]>::new();
    for (bin, [_, matched, expected]) in frames.iter().flatten() {
        let sum = all.entry(*bin).or_default();
        *sum = [sum[0] + matched, sum[1] + expected];
    }
    let is_below = |bin: &Bin, [n, matched, expected]: [f64; 3]| {
        // Dirt or a post in its direction may take a part in all scans.
        let [seen, of_others] = [all[bin][0] - matched, all[bin][1] - expected];
        let expected = expected * (seen / of_others.max(1e-9)).min(1.0);
        matched < share * expected && expected > USUALLY_SEEN * n
    };
    let of_frame = |(f, other): (&Counts, &Counts)| {
        let empty = |bin: &Bin, n: f64| other.get(bin).is_none_or(|c| c[0] < share * n);
        f.iter().filter(|(bin, c)| is_below(bin, **c) && empty(bin, c[0])).map(|(bin, _)| *bin).collect()
    };
    frames.iter().zip(other).map(of_frame).collect()
}

/// Number of runs of dark bins of a sensor in a frame.
fn runs_of(dark: &BTreeSet<Bin>, sensor: u8) -> usize {
    dark.iter().filter(|(s, bin)| *s == sensor && !dark.contains(&(sensor, bin - 1))).count()
}

/// The finding.
fn found(context: &Context, runs: &Runs, [share, of_share]: [f64; 2], held_out_gains: Vec<f64>) -> Found {
    let sensor = &context.rig.sensors[runs.sensor];
    let scan_ms = 1e3 / sensor.rate_hz;
    let packet_ms = runs.packet() * scan_ms;
    let [least, most] = runs.packet_interval();
    let [loss, burst] = runs.probabilities(runs.packet());
    let error = (runs.lengths.len() as f64).max(1.0).sqrt().recip();
    let mut of_runs = with_error(share, of_share, Quantity::Share.unit());
    of_runs.ci95[0] = of_runs.ci95[0].max(0.0);
    // Both ends of the width of a packet, each with the error of the number of runs.
    let interval = |k: usize, estimate: f64, of: f64| {
        let ends = [least, most].map(|packet| runs.probabilities(packet)[k]);
        let [low, high] = [ends[0].min(ends[1]), ends[0].max(ends[1])];
        let ci95 = [low.min(estimate) - 1.96 * of, high.max(estimate) + 1.96 * of].map(|end| end.clamp(0.0, 1.0));
        Parameter { estimate, unit: Quantity::Burst.unit(), ci95 }
    };
    let points = curve_points(runs, scan_ms);
    Found {
        effects: Vec::new(),
        status: Status::Named,
        causes: vec![Cause::PacketLoss],
        parameters: vec![
            sensor_number(runs.sensor),
            (
                Quantity::PacketMs.into(),
                Parameter {
                    estimate: packet_ms,
                    unit: Quantity::PacketMs.unit(),
                    ci95: [least, most].map(|w| w * scan_ms),
                },
            ),
            (Quantity::Loss.into(), interval(0, loss, loss * error)),
            (Quantity::Burst.into(), interval(1, burst, (1.0 - burst) * error)),
            (Quantity::Share.into(), of_runs),
        ],
        confidence: 1.0,
        channel: Channel::Packets,
        covariate: Covariate::ScanPhase,
        held_out_gains,
        says: format!(
            "in single scans all returns of some time are lost ({:.1} % of the returns): packets of {packet_ms:.1} ms do not arrive",
            100.0 * share
        ),
        separate_by: None,
        curve: Curve {
            x: "time for which all is lost, ms".into(),
            y: "number of losses".into(),
            by_sensor: false,
            points,
        },
    }
}

/// How many runs there are of each width, and how many the Gilbert channel has.
fn curve_points(runs: &Runs, scan_ms: f64) -> Vec<CurvePoint> {
    let (packet, [_, burst]) = (runs.packet(), runs.probabilities(runs.packet()));
    let number = runs.lengths.len() as f64;
    let point = |k: i32| {
        let inside = |w: &&f64| ((**w / packet).round() as i32) == k;
        let measured = runs.lengths.iter().filter(inside).count() as f64;
        let after = number * (1.0 - burst) * burst.powi(k - 1);
        let x = f64::from(k) * packet * scan_ms;
        CurvePoint { sensor: 0, x, measured, before: 0.0, after, error: measured.sqrt() }
    };
    (1..=12).map(point).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Thirty frames of 400 bins with twenty returns each.
    fn frames(lost: impl Fn(usize, i32) -> bool) -> Vec<Counts> {
        let cell = |f: usize, bin: i32| ((0u8, bin), [20.0, if lost(f, bin) { 0.0 } else { 19.0 }, 18.0]);
        (0..30).map(|f| (0..400).map(|bin| cell(f, bin)).collect()).collect()
    }

    #[test]
    fn bins_that_are_dark_in_one_frame_count_and_those_that_always_are_do_not() {
        let counts = frames(|f, bin| (100..105).contains(&bin) || f == 7 && (200..204).contains(&bin));
        let nothing = vec![Counts::new(); counts.len()];
        let dark = bins_below(DARK, &counts, &nothing);
        assert_eq!(dark[7].iter().map(|b| b.1).collect::<Vec<_>>(), [200, 201, 202, 203]);
        assert!(dark[6].is_empty());
    }

    #[test]
    fn bins_of_all_shades_are_no_packets_and_what_the_other_side_has_is_none() {
        // Every seventh bin of each frame keeps something between nothing and a third of its returns.
        let shade = |f: usize, bin: i32| (bin + f as i32) % 7 == 0;
        let matched = |f: usize, bin: i32| if shade(f, bin) { f64::from((3 * bin + f as i32) % 7) } else { 19.0 };
        let cell = |f: usize, bin: i32| ((0u8, bin), [20.0, matched(f, bin), 19.0]);
        let counts: Vec<Counts> = (0..30).map(|f| (0..400).map(|bin| cell(f, bin)).collect()).collect();
        let nothing = vec![Counts::new(); counts.len()];
        let number = |of: &[BTreeSet<Bin>]| of.iter().map(BTreeSet::len).sum::<usize>();
        let packets = Packets {
            orders: vec![],
            sides: [Dark::new(counts.clone(), &nothing), Dark(vec![BTreeSet::new(); 30], nothing.clone())],
        };
        let (dark, dim) = (number(&packets.sides[0].0), packets.dim(&(0..30).collect::<Vec<_>>()));
        assert!(dark > 100 && dim as f64 > DIM_BINS * dark as f64, "{dark} {dim}");
        assert_eq!(number(&bins_below(DARK, &counts, &counts)), 0, "another thing is there");
    }

    #[test]
    fn packets_and_bursts_are_found_with_their_probabilities() {
        use rand::RngExt;
        // Packets of four bins, with their ends inside of bins: three bins of each single one are dark.
        let mut rng = data::stream(0, "packets", 0, 0);
        let (loss, burst) = (0.03, 0.4);
        let mut lost = vec![vec![false; 100]; 30];
        for frame in &mut lost {
            let mut before = false;
            for packet in frame.iter_mut() {
                *packet = rng.random_bool(if before { burst } else { loss });
                before = *packet;
            }
        }
        let dark = |f: usize, bin: i32| {
            let of = |b: i32| lost[f][(b / 4).clamp(0, 99) as usize];
            of(bin) && (bin == 0 || of(bin - 1))
        };
        let counts = frames(dark);
        let all: Vec<usize> = (0..30).collect();
        let nothing = vec![Counts::new(); counts.len()];
        let runs = Runs::new(&bins_below(DARK, &counts, &nothing), &counts, &all, &[0.0025]);
        assert!((runs.packet() / 0.0025 - 4.0).abs() < 0.1, "{}", runs.packet() / 0.0025);
        let [found_loss, found_burst] = runs.probabilities(runs.packet());
        assert!((found_loss / loss - 1.0).abs() < 0.35, "{found_loss}");
        assert!((found_burst - burst).abs() < 0.15, "{found_burst}");
    }
}
