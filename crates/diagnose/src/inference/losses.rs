//! Lost returns by cell: the share of simulated returns with a measured counterpart, and fits of laws to it.

use super::descent::{Slopes, descend};
use super::law::{FittedLaw, Form, Law, WHOLE_OBJECT, Where, in_zone};
use crate::channels::cells::{CELLS, OBJECT, ZONES, cells_around, zone_of};
use crate::channels::hits::{HitCell, HitFrame};
use nalgebra::DVector;
use std::collections::BTreeMap;
use std::ops::RangeInclusive;

/// Counts of some frames, with the share that would match without losses.
#[derive(Clone, Debug)]
pub struct LossTable {
    places: Vec<Where>,
    /// Whether returns of objects are met at all cosines of incidence alike, whatever their cells say.
    round: bool,
    /// Share of measured returns with a simulated counterpart: matching misses some on both sides.
    matches: Vec<f64>,
    cells: Vec<HitCell>,
    used: Vec<usize>,
}

/// Weight of the share of matches in the cells around a cell, and of that in its zone, returns.
const PRIOR_OF_MATCHES: f64 = 20.0;

/// Weight of the share that laws keep in a cell, returns.
const PRIOR_RETURNS: f64 = 60.0;

/// Width of a bin of the covariate of a law whose form is free, of ln(m), ln(cos) or ln(signal): that of the cells.
pub const FORM_BIN: f64 = 0.25;

/// Cosines at which a curved body is met.
const ON_ROUND: [f64; 10] = [0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.95];

/// Shares beyond which nothing is certain.
const CERTAIN: RangeInclusive<f64> = 1e-4..=1.0 - 1e-4;

/// Fewest simulated returns of a cell.
const FEWEST: f64 = 40.0;

/// Share of the measured returns of each cell with a simulated counterpart. Where the cell has few, that of the cells
/// around it counts as well, and where these have few, that of its zone: where the simulation itself loses returns, the
/// share falls from cell to cell.
fn shares_of_matches(cells: &[HitCell]) -> Vec<f64> {
    let add = |[n, matched]: [f64; 2], i: usize| [n + cells[i].measured.n, matched + cells[i].matched];
    let mut by_zone = [[0.0; 2]; ZONES];
    (0..cells.len()).for_each(|i| by_zone[zone_of(i)] = add(by_zone[zone_of(i)], i));
    let of_zones = by_zone.map(|[n, matched]| (matched + 0.5) / (n + 1.0));
    let shrunk = |[n, matched]: [f64; 2], to: f64| (matched + PRIOR_OF_MATCHES * to) / (n + PRIOR_OF_MATCHES);
    let share = |i: usize| {
        let around = shrunk(cells_around(i).fold([0.0; 2], add), of_zones[zone_of(i)]);
        shrunk(add([0.0; 2], i), around).clamp(0.02, 0.9999)
    };
    (0..cells.len()).map(share).collect()
}

impl LossTable {
    /// From the sums over some frames.
    pub fn new(cells: Vec<HitCell>) -> Self {
        let matches = shares_of_matches(&cells);
        let places = cells
            .iter()
            .enumerate()
            .map(|(i, c)| {
                let (range, cos) = c.simulated.mean();
                Where { ln_range: range.ln(), ln_cos: cos.ln(), zone: zone_of(i) }
            })
            .collect();
        let used = (0..CELLS).filter(|&i| cells[i].simulated.n >= FEWEST).collect();
        LossTable { places, round: false, matches, cells, used }
    }

    /// The same counts where objects are met at all cosines of incidence alike: those of curved bodies are not known.
    pub fn of_round_objects(&self) -> Self {
        LossTable { round: true, ..self.clone() }
    }

    /// Where the returns of a cell lie.
    fn met(&self, cell: usize) -> impl Iterator<Item = Where> {
        let place = self.places[cell];
        let round = self.round && place.zone >= OBJECT;
        let at = move |cos: f64| Where { ln_cos: cos.ln(), ..place };
        ON_ROUND.into_iter().filter(move |_| round).map(at).chain((!round).then_some(place))
    }

    /// Mean over the returns of a cell.
    fn mean_of(&self, cell: usize, of: impl Fn(&Where) -> f64) -> f64 {
        let [n, sum] = self.met(cell).fold([0.0; 2], |[n, sum], at| [n + 1.0, sum + of(&at)]);
        sum / n
    }

    /// Share that a law keeps in a cell.
    pub fn kept(&self, laws: &[FittedLaw], cell: usize) -> f64 {
        self.mean_of(cell, |at| laws.iter().map(|law| law.kept(at)).product())
    }

    /// Share of simulated returns of a cell that have a counterpart.
    fn matched(&self, laws: &[FittedLaw], cell: usize) -> f64 {
        self.matched_share(self.kept(laws, cell), cell)
    }

    /// The same where a share is kept.
    fn matched_share(&self, kept: f64, cell: usize) -> f64 {
        (kept * self.matches[cell]).clamp(*CERTAIN.start(), *CERTAIN.end())
    }

    /// Logarithm of the likelihood of these counts.
    fn likelihood(&self, laws: &[FittedLaw], cells: impl Iterator<Item = (usize, f64, f64)>) -> f64 {
        self.likelihood_of(|i| self.kept(laws, i), cells)
    }

    /// The same for any share that is kept in each cell.
    fn likelihood_of(&self, kept: impl Fn(usize) -> f64, cells: impl Iterator<Item = (usize, f64, f64)>) -> f64 {
        cells
            .map(|(i, n, matched)| {
                let p = self.matched_share(kept(i), i);
                matched * p.ln() + (n - matched) * (1.0 - p).ln()
            })
            .sum()
    }

    /// Fits a law together with others; parameters of the others are fitted anew.
    pub fn fit(&self, before: &[FittedLaw], law: Law) -> Vec<FittedLaw> {
        let places: Vec<Where> = self.used.iter().map(|&i| self.places[i]).collect();
        let from = |start: FittedLaw| {
            let laws: Vec<FittedLaw> = before.iter().copied().chain([start]).collect();
            let start = DVector::from_vec(numbers_of(&laws));
            let bounds: Vec<[f64; 2]> = laws.iter().flat_map(|l| l.law.bounds()).collect();
            let with = |p: &DVector<f64>| with_numbers(&laws, p.as_slice());
            let (at, least) = descend(start, &bounds, |p| self.improbability(&with(p)), |p| self.slopes(&with(p)));
            (with(&at), least)
        };
        let fits = law.starts(&places).into_iter().map(from);
        fits.min_by(|a, b| a.1.total_cmp(&b.1)).map(|fit| fit.0).unwrap_or_default()
    }

    /// Minus the logarithm of the probability of laws and of all counts, up to a constant.
    fn improbability(&self, laws: &[FittedLaw]) -> f64 {
        let forms: Vec<Form> = laws.iter().map(FittedLaw::form).collect();
        let kept = |i: usize| self.mean_of(i, |at| forms.iter().map(|form| form.kept(at)).product());
        let counts = self.used.iter().map(|&i| (i, self.cells[i].simulated.n, self.cells[i].matched));
        let of_laws = laws.iter().flat_map(FittedLaw::improbable).map(|v| v * v).sum::<f64>();
        of_laws - self.likelihood_of(kept, counts)
    }

    /// Its derivatives by the numbers of the laws. The curvature is the information of the counts.
    fn slopes(&self, laws: &[FittedLaw]) -> Slopes {
        let forms: Vec<Form> = laws.iter().map(FittedLaw::form).collect();
        let numbers: usize = laws.iter().map(|l| l.law.count()).sum();
        let mut out = Slopes::zeros(numbers);
        let mut by = Vec::new();
        for &i in &self.used {
            let kept: Vec<(Where, f64)> =
                self.met(i).map(|at| (at, forms.iter().map(|form| form.kept(&at)).product())).collect();
            let all: f64 = kept.iter().map(|(_, kept)| kept).sum();
            let share = all / kept.len() as f64 * self.matches[i];
            if !CERTAIN.contains(&share) {
                continue;
            }
            let [n, matched] = [self.cells[i].simulated.n, self.cells[i].matched];
            by.clear();
            by.resize(numbers, 0.0);
            for (at, kept) in &kept {
                let slopes =
                    forms.iter().zip(laws).flat_map(|(form, law)| form.slopes(at).into_iter().take(law.law.count()));
                by.iter_mut().zip(slopes).for_each(|(by, slope)| *by += kept / all * slope);
            }
            // By the logarithm of the share.
            let slope = (n * share - matched) / (1.0 - share);
            out.add(&by, slope, n * share / (1.0 - share));
        }
        let mut first = 0;
        for law in laws {
            out.add_improbable(law, first);
            first += law.law.count();
        }
        out
    }

    /// Counts of a frame in the cells that are used.
    fn counts<'f>(&'f self, frame: &'f HitFrame) -> impl Iterator<Item = (usize, f64, f64)> + 'f {
        frame
            .iter()
            .map(|(i, c)| (*i as usize, c.simulated.n, c.matched))
            .filter(|(i, ..)| self.cells[*i].simulated.n >= FEWEST)
    }

    /// Gain of a frame by `laws` over `before`, nats; match probabilities are those of this table.
    pub fn gain(&self, frame: &HitFrame, laws: &[FittedLaw], before: &[FittedLaw]) -> f64 {
        self.likelihood(laws, self.counts(frame)) - self.likelihood(before, self.counts(frame))
    }

    /// The same for the shares that are kept in each cell.
    pub fn gain_of_shares(&self, frame: &HitFrame, kept: &[f64], before: &[f64]) -> f64 {
        self.likelihood_of(|i| kept[i], self.counts(frame)) - self.likelihood_of(|i| before[i], self.counts(frame))
    }

    /// Share that laws keep in each cell where the form of each of `free` is free: no sensor has exactly the form of a
    /// law. The ratio of the matched returns to those that are expected replaces it along its covariate, one law after
    /// the other.
    pub fn kept_by_forms(&self, laws: &[FittedLaw], free: &[FittedLaw]) -> Vec<f64> {
        let mut kept: Vec<f64> = (0..CELLS).map(|i| self.kept(laws, i)).collect();
        for law in free {
            let bin = |i: usize| law.covariate(&self.places[i]).map(|x| (x / FORM_BIN).floor() as i32);
            let mut sums = BTreeMap::<i32, [f64; 2]>::new();
            for (i, bin) in self.used.iter().filter_map(|&i| Some((i, bin(i)?))) {
                let sum = sums.entry(bin).or_default();
                sum[0] += self.cells[i].matched;
                sum[1] += self.cells[i].simulated.n * kept[i] * self.matches[i];
            }
            for &i in &self.used {
                let [matched, expected] = bin(i).and_then(|bin| sums.get(&bin)).copied().unwrap_or_default();
                kept[i] *= (matched + PRIOR_RETURNS) / (expected + PRIOR_RETURNS);
            }
        }
        kept
    }

    /// Share of matched returns of each cell in these frames, shrunk towards the laws: an unconstrained lookup table.
    pub fn matched_shares(&self, laws: &[FittedLaw]) -> Vec<f64> {
        let share = |(i, c): (usize, &HitCell)| {
            let towards = self.matched(laws, i);
            ((c.matched + PRIOR_RETURNS * towards) / (c.simulated.n + PRIOR_RETURNS)).clamp(1e-4, 1.0 - 1e-4)
        };
        self.cells.iter().enumerate().map(share).collect()
    }

    /// Shares of the simulated and of the measured returns of each cell that have no counterpart.
    pub fn unmatched(&self, laws: &[FittedLaw]) -> Vec<[f64; 2]> {
        let unmatched = |(i, share): (usize, f64)| [1.0 - share, 1.0 - self.matched(&[], i)];
        self.matched_shares(laws).into_iter().enumerate().map(unmatched).collect()
    }

    /// Gain of a frame by a lookup table of matched shares, nats.
    pub fn gain_by_table(&self, frame: &HitFrame, shares: &[f64]) -> f64 {
        let used = frame.iter().filter(|(i, _)| self.cells[*i as usize].simulated.n >= FEWEST);
        used.map(|(i, c)| {
            let (p, q) = (self.matched(&[], *i as usize), shares[*i as usize]);
            let (n, matched) = (c.simulated.n, c.matched);
            matched * (q / p).ln() + (n - matched) * ((1.0 - q) / (1.0 - p)).ln()
        })
        .sum()
    }

    /// Kullback-Leibler distance of a frame's counts from a simulation without losses, nats.
    pub fn distance(&self, frame: &HitFrame) -> f64 {
        let mut sum = 0.0;
        for (i, c) in frame {
            let (n, matched) = (c.simulated.n, c.matched);
            if self.cells[*i as usize].simulated.n < FEWEST || n < 1.0 {
                continue;
            }
            let p = self.matched(&[], *i as usize);
            let part = |k: f64, q: f64| if k > 0.0 { k * (k / n / q).ln() } else { 0.0 };
            sum += part(matched, p) + part(n - matched, 1.0 - p);
        }
        sum
    }

    /// Range beyond which one simulated return in fifty lies, m; 0 where there are none.
    pub fn farthest_m(&self) -> f64 {
        self.last(|p| p.ln_range).exp()
    }

    /// Cosine of incidence below which one simulated return in fifty lies; 1 where there are none.
    pub fn most_grazing(&self) -> f64 {
        (-self.last(|p| -p.ln_cos)).exp().min(1.0)
    }

    /// The 98 % quantile of a value over simulated returns.
    fn last(&self, value: impl Fn(&Where) -> f64) -> f64 {
        let mut values: Vec<(f64, f64)> =
            self.used.iter().map(|&i| (value(&self.places[i]), self.cells[i].simulated.n)).collect();
        values.sort_by(|a, b| b.0.total_cmp(&a.0));
        let all: f64 = values.iter().map(|v| v.1).sum();
        let mut beyond = 0.0;
        let at = values.iter().find(|(_, n)| {
            beyond += n;
            beyond > 0.02 * all
        });
        at.map_or(f64::NEG_INFINITY, |v| v.0)
    }

    /// Share that laws keep, in the order of [`LossTable::shares`].
    pub fn kept_shares(&self, laws: &[FittedLaw]) -> Vec<f64> {
        self.used.iter().map(|&i| self.kept(laws, i)).collect()
    }

    /// Mean of a value of the cells over simulated returns.
    fn mean(&self, of: impl Fn(usize) -> f64) -> f64 {
        let n: f64 = self.used.iter().map(|&i| self.cells[i].simulated.n).sum();
        self.used.iter().map(|&i| self.cells[i].simulated.n * of(i)).sum::<f64>() / n.max(1.0)
    }

    /// Share of simulated returns that the laws lose.
    pub fn lost(&self, laws: &[FittedLaw]) -> f64 {
        self.mean(|i| 1.0 - self.kept(laws, i))
    }

    /// Mean absolute difference of the shares that some laws and others keep, over simulated returns.
    pub fn changed(&self, laws: &[FittedLaw], others: &[FittedLaw]) -> f64 {
        self.mean(|i| (self.kept(laws, i) - self.kept(others, i)).abs())
    }

    /// Share of the measured returns, of one kind of surface or of all, that the simulated side lacks.
    pub fn only_measured(&self, zone: Option<usize>) -> f64 {
        let of_zone = |i: &&usize| zone.is_none_or(|zone| in_zone(zone, self.places[**i].zone));
        let sum = |of: fn(&HitCell) -> f64| self.used.iter().filter(of_zone).map(|&i| of(&self.cells[i])).sum::<f64>();
        (sum(|c| c.measured.n) - sum(|c| c.matched)) / sum(|c| c.measured.n).max(1.0)
    }

    /// The kind of standing surface or object with more than nine tenths of the losses; `None` without one.
    pub fn confined_to(&self, laws: &[FittedLaw]) -> Option<usize> {
        let mut lost = [0.0f64; ZONES];
        for &i in &self.used {
            lost[self.places[i].zone] += self.cells[i].simulated.n * (1.0 - self.kept(laws, i)).max(0.0);
        }
        let all: f64 = lost.iter().sum();
        let of = |z: usize| (0..ZONES).filter(|k| in_zone(z, *k)).map(|k| lost[k]).sum::<f64>();
        (1..=WHOLE_OBJECT).find(|&z| of(z) > 0.9 * all)
    }

    /// Cells with enough returns: ln range, ln cos, zone, returns, ratio of the matched share to that without losses.
    pub fn shares(&self) -> Vec<([f64; 2], usize, f64, f64)> {
        self.used
            .iter()
            .map(|&i| {
                let (c, p) = (&self.cells[i], &self.places[i]);
                ([p.ln_range, p.ln_cos], p.zone, c.simulated.n, c.matched / c.simulated.n / self.matches[i])
            })
            .collect()
    }
}

impl Slopes {
    /// Adds a term of which the derivatives by the parameters are `by`, times its own first and second one.
    fn add(&mut self, by: &[f64], slope: f64, curvature: f64) {
        for (j, &of_j) in by.iter().enumerate().filter(|(_, v)| **v != 0.0) {
            self.gradient[j] += slope * of_j;
            for (k, &of_k) in by.iter().enumerate() {
                self.curvature[(j, k)] += curvature * of_j * of_k;
            }
        }
    }

    /// Adds the squares of what is improbable of a law, whose numbers are the parameters from `first` on.
    fn add_improbable(&mut self, law: &FittedLaw, first: usize) {
        const STEP: f64 = 1e-6;
        let here = law.improbable();
        let beside = |k: usize| {
            let mut moved = *law;
            moved.numbers[k] += STEP;
            moved.improbable()
        };
        let beside: Vec<Vec<f64>> = (0..law.law.count()).map(beside).collect();
        for (r, &value) in here.iter().enumerate() {
            let mut by = vec![0.0; first];
            by.extend(beside.iter().map(|moved| (moved[r] - value) / STEP));
            self.add(&by, 2.0 * value, 2.0);
        }
    }
}

/// The numbers of some laws, one after the other.
fn numbers_of(laws: &[FittedLaw]) -> Vec<f64> {
    laws.iter().flat_map(|l| &l.numbers[..l.law.count()]).copied().collect()
}

/// Laws with other numbers, in the order of [`numbers_of`].
fn with_numbers(laws: &[FittedLaw], numbers: &[f64]) -> Vec<FittedLaw> {
    let mut at = 0;
    laws.iter()
        .map(|l| {
            let n = l.law.count();
            let mut out = *l;
            out.numbers[..n].copy_from_slice(&numbers[at..at + n]);
            at += n;
            out
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channels::cells::{COS_BINS, RANGE_BINS};
    use crate::inference::law::LAWS;
    use crate::inference::simplex::minimise;

    /// Counts without noise: ground where cos = 1 / R, walls of all angles.
    fn table(keep: impl Fn(f64, f64, usize) -> f64) -> LossTable {
        let mut cells = vec![HitCell::default(); CELLS];
        for zone in 0..ZONES {
            for r in 4..18 {
                for c in 0..12 {
                    let (range, cos) = ((0.25f64 * (r as f64 + 0.5)).exp(), (-0.4 * (c as f64 + 0.5)).exp());
                    if zone == 0 && (cos * range).ln().abs() > 0.5 {
                        continue;
                    }
                    let cell = &mut cells[(zone * COS_BINS + c) * RANGE_BINS + r];
                    let (n, kept) = (1000.0, keep(range, cos, zone));
                    cell.simulated.n = n;
                    cell.simulated.ln_range = n * range.ln();
                    cell.simulated.ln_cos = n * cos.ln();
                    cell.measured.n = n * kept;
                    cell.matched = n * kept * 0.97;
                }
            }
        }
        LossTable::new(cells)
    }

    fn best(table: &LossTable) -> (Law, FittedLaw) {
        let frame: HitFrame = table.cells.iter().enumerate().map(|(i, c)| (i as u32, *c)).collect();
        let fits = LAWS.map(|law| table.fit(&[], law)[0]);
        let gain = |f: &FittedLaw| table.gain(&frame, &[*f], &[]) - f.law.parameters() as f64;
        let best = fits.into_iter().max_by(|a, b| gain(a).total_cmp(&gain(b))).unwrap();
        (best.law, best)
    }

    /// Improbability of laws with these numbers; infinite beyond their bounds.
    fn within(table: &LossTable, laws: &[FittedLaw], numbers: &[f64]) -> f64 {
        let mut bounds = laws.iter().flat_map(|l| l.law.bounds()).zip(numbers);
        let inside = bounds.all(|([low, high], v)| (low..=high).contains(v));
        if inside { table.improbability(&with_numbers(laws, numbers)) } else { f64::INFINITY }
    }

    #[test]
    fn no_simplex_finds_more_probable_laws() {
        let two = |r: f64, c: f64| 0.9 / ((1.0 + (0.12 / c).powi(3)) * (1.0 + (r / 60.0).powi(5)));
        let tables =
            [table(|r, c, z| two(r, c) * if z == 2 { 0.6 } else { 1.0 }), table(|r, c, _| (40.0 * c / r).min(1.0))];
        for table in &tables {
            for (law, before) in LAWS.into_iter().flat_map(|law| [(law, None), (law, Some(Law::Incidence))]) {
                let before = before.map_or(vec![], |before| table.fit(&[], before));
                let fit = table.fit(&before, law);
                let found = table.improbability(&fit);
                let numbers = numbers_of(&fit);
                let value = |p: &[f64]| within(table, &fit, p);
                let from_there = minimise(&numbers, &vec![0.01; numbers.len()], value).1;
                assert!(found - from_there < 0.05, "{law:?} {found} {from_there} {fit:?}");
                // From where the descent began as well.
                let starts = law.starts(&table.used.iter().map(|&i| table.places[i]).collect::<Vec<_>>());
                for start in starts {
                    let laws: Vec<FittedLaw> = before.iter().copied().chain([start]).collect();
                    let numbers = numbers_of(&laws);
                    let value = |p: &[f64]| within(table, &laws, p);
                    let steps = vec![0.3; numbers.len()];
                    assert!(found - minimise(&numbers, &steps, value).1 < 0.5, "{law:?} {found}");
                }
            }
        }
    }

    #[test]
    fn dark_wheels_are_a_part_of_the_law_of_the_signal() {
        let brightness = [0.0, 0.5, 1.0, -1.5];
        let table = table(|range, cos, zone| {
            let x = (cos / range.powi(2)).ln() + brightness[zone];
            1.0 / (1.0 + (-2.0 * (x + 8.0)).exp())
        });
        let fit = table.fit(&[], Law::Signal)[0];
        let [.., standing, bodies, wheels] = fit.numbers;
        for (got, want) in [(standing, 0.5), (bodies, 1.0), (wheels, -1.5)] {
            assert!((got - want).abs() < 0.2, "{fit:?}");
        }
        assert_eq!(best(&table).0, Law::Signal);
    }

    #[test]
    fn laws_that_share_a_loss_change_nothing() {
        let table = table(|_, _, _| 0.8);
        let [alone, half] =
            [0.2, 0.105573].map(|a| FittedLaw { law: Law::Random, numbers: [a, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0] });
        assert!(table.changed(&[half, half], &[alone]) < 1e-4);
        assert!((table.changed(&[alone, half], &[alone]) - 0.8 * 0.105573).abs() < 1e-6);
    }

    #[test]
    fn beside_a_free_form_a_second_law_gains_what_the_form_does_not() {
        // The law of the sensor has another form than the fitted one: two steps of the signal.
        let signal = |r: f64, c: f64| {
            let step = |at: f64| 0.5 * (1.0 + (6.0 * ((c / (r * r)).ln() - at)).tanh());
            0.3 + 0.3 * step(-7.0) + 0.4 * step(-11.0)
        };
        let gain = |table: &LossTable, law: Law| {
            let frame: HitFrame = table.cells.iter().enumerate().map(|(i, c)| (i as u32, *c)).collect();
            let before = table.fit(&[], Law::Signal);
            let both = table.fit(&before, law);
            let [kept, form] = [table.kept_by_forms(&both, &both[..1]), table.kept_by_forms(&before, &before)];
            [table.gain(&frame, &both, &before), table.gain_of_shares(&frame, &kept, &form)]
        };
        let [by_law, by_form] = gain(&table(|r, c, _| signal(r, c)), Law::Signal);
        assert!(by_law > 500.0 && by_form < 0.2 * by_law, "{by_law} {by_form}");
        let [_, of_material] = gain(&table(|r, c, z| signal(r, c) * if z == 2 { 0.7 } else { 1.0 }), Law::Zone(2));
        assert!(of_material > 1000.0, "{of_material}");
    }

    #[test]
    fn on_round_bodies_a_law_of_incidence_is_no_material() {
        // What is met at all cosines is counted where they are 0.6.
        let kept = |c: f64| 1.0 / (1.0 + (0.2 / c).powi(6));
        let on_round = (0..1000).map(|k| kept((f64::from(k) + 0.5) / 1000.0) / 1000.0).sum::<f64>();
        let share = |of_material: f64, round: bool| {
            let body = |c: f64| if (0.5..0.7).contains(&c) { on_round * (1.0 - of_material) } else { 0.0 };
            let mut table = table(|_, c, z| if z == 2 { body(c) } else { kept(c) });
            table.used.retain(|&i| table.places[i].zone < 2 || (-0.7..-0.4).contains(&table.places[i].ln_cos));
            let table = if round { table.of_round_objects() } else { table };
            table.fit(&table.fit(&[], Law::Incidence), Law::Zone(2))[1].numbers[0]
        };
        assert!(share(0.0, false) > 0.15, "{}", share(0.0, false));
        assert!(share(0.0, true).abs() < 0.03, "{}", share(0.0, true));
        assert!((share(0.3, true) - 0.3).abs() < 0.03, "{}", share(0.3, true));
    }

    #[test]
    fn each_law_is_distinguished_from_the_others() {
        let (law, fit) = best(&table(|_, _, _| 0.8));
        assert_eq!(law, Law::Random);
        assert!((fit.numbers[0] - 0.2).abs() < 5e-3, "{fit:?}");
        let (law, fit) = best(&table(|r, _, _| 1.0 / (1.0 + (r / 40.0).powi(4))));
        assert_eq!(law, Law::Range);
        assert!((fit.half().exp() - 40.0).abs() < 2.0, "{fit:?}");
        assert_eq!(best(&table(|_, c, _| c * c / (c * c + 0.01))).0, Law::Incidence);
        let (law, fit) = best(&table(|r, c, z| {
            let u = (c / (r * r)).ln() + if z > 0 { 1.0 } else { 0.0 };
            0.985 * 0.5 * (1.0 + (2.0 * (u + 10.5)).tanh())
        }));
        assert_eq!(law, Law::Signal);
        assert!((fit.half() + 10.5).abs() < 0.3 && (fit.numbers[4] - 1.0).abs() < 0.3, "{fit:?}");
        assert!((fit.most() - 0.985).abs() < 4e-3, "{fit:?}");
        let (law, fit) = best(&table(|_, _, z| if z == 2 { 0.4 } else { 1.0 }));
        assert_eq!(law, Law::Zone(2));
        assert!((fit.numbers[0] - 0.6).abs() < 0.02);
    }
}
