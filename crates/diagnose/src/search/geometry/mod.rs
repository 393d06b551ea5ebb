//! Where surfaces lie: range biases, poses of sensors and of the ego vehicle, rows that aim or measure wrongly, and
//! unexplained offsets by azimuth or by range.

mod beside_rows;
mod common_turns;
mod curve;
mod describe;
mod directions;
mod displacement;
mod floor;
pub mod ground;
mod hypotheses;
mod own_scatter;
mod reported;
mod row_offsets;
mod rows;
mod selection;
mod steadiness;
mod sums;
pub mod vibration;
pub mod walk;
mod wandering;

pub use self::displacement::{Displacement, Swept};

use self::common_turns::common_turns;
use self::displacement::displacement;
use self::floor::above_floor;
use self::hypotheses::Hypothesis;
use self::reported::Reported;
use self::sums::{Sums, sums};
use self::wandering::wandering;
use super::confounders::is_confirmed;
use super::rolling_shutter::Slide;
use super::{ChannelResult, Context, Selected, Z_STAR, first_demands};
use crate::catalogue::{Cause, Channel};
use crate::channels::groups::Grouping;
use crate::channels::mean::Column;
use crate::channels::moments::COURSES;
use crate::diagnosis::Considered;
use crate::error::DiagnoseError;
use crate::inference::choice::{Demands, significant, total_and_z};
use crate::inference::roles::Role;
use crate::pairing::FramePair;

/// Frames by role, their sums and what is demanded of a hypothesis.
struct Search<'a> {
    context: &'a Context<'a>,
    /// Whether a displacement over a scan was undone.
    is_moved_back: bool,
    /// What may be left of it.
    swept: Vec<Column>,
    /// Of the frames as they are; once the hypotheses are chosen, of those with the displacement undone.
    sums: Sums,
    /// The frames with the displacement undone, once there are any.
    undone: Option<Vec<FramePair>>,
    select: Vec<usize>,
    /// Blocks of the selecting frames.
    blocks: Vec<usize>,
    estimate: Vec<usize>,
    estimate_blocks: Vec<usize>,
    hold_out: Vec<usize>,
    demands: Demands,
    /// What is reported of the chosen hypotheses, once there are any.
    reported: Option<Reported>,
    /// Simulated returns of the selecting frames.
    returns: f64,
}

/// Chosen hypotheses, with what the selection says of each.
type Chosen = (Vec<Hypothesis>, Vec<Selected>);

/// A displacement over a scan that was chosen, with its gains on the held-out frames, nats.
struct Sheared {
    hypothesis: Hypothesis,
    selected: Selected,
    gains: Vec<f64>,
}

/// Gains of the `test` frames by unconstrained tables fitted on the `train` frames, nats: all poses and biases
/// together or offsets of strips of azimuth, whichever is more, offsets of rows beyond those of their neighbours, and
/// offsets of steps of range.
pub fn by_table(context: &Context, train: &[usize], test: &[usize]) -> Vec<f64> {
    let sums = sums(context, train, &Displacement::default(), &[]);
    let (full, base) = sums.full_and_base(train, &context.blocks(train));
    let linear: Vec<f64> = test.iter().map(|&f| full.gain(&sums.linear[f]) - base.gain(&sums.linear[f])).collect();
    // Offsets that one part of the rays of a row or strip predicts for the other parts: those of the sensor, not of
    // surfaces.
    let mut all = [train, test].concat();
    all.sort_unstable();
    let blocks = context.blocks(&all);
    let groups = |grouping: Grouping, column: usize| -> Vec<f64> {
        let cause = Cause::Unexplained;
        let gains = sums.group_gains(&all, &blocks, grouping, &[column]);
        let large = || above_floor(&sums, &all, &blocks, &[Hypothesis::Groups { cause, grouping, column }]);
        if !significant(&gains, Z_STAR) || !large() {
            return vec![0.0; test.len()];
        }
        test.iter().map(|f| all.iter().position(|own| own == f).map_or(0.0, |at| gains[at])).collect()
    };
    let more = |a: Vec<f64>, b: Vec<f64>| if a.iter().sum::<f64>() >= b.iter().sum() { a } else { b };
    let smooth = more(linear, groups(Grouping::Azimuth, 0));
    let rough = more(groups(Grouping::Row, 0), groups(Grouping::Row, 1));
    let steps = groups(Grouping::Range, 0);
    smooth.iter().zip(rough).zip(steps).map(|((a, b), c)| a + b + c).collect()
}

/// Pairs the frames anew with a displacement undone.
pub type Undo<'a> = &'a dyn Fn(&Displacement) -> Result<Vec<FramePair>, DiagnoseError>;

/// What the search found.
pub struct Geometry {
    /// Findings.
    pub result: ChannelResult,
    /// The displacement that the other channels have to undo.
    pub displaced: Displacement,
    /// The displacement over a scan, or what was left of one that was undone.
    pub swept: Option<Swept>,
}

/// The search. Turns and shifts of metres at the far end are not linear, nor is the place where a row meets the ground
/// near its horizon: what was chosen is fitted a second time, on frames that `undo` pairs anew. Where a displacement
/// over a scan was undone before, what may be left of it is fitted with all else. Where one is chosen it is undone
/// first, and the search begins anew: it leaves every sensor with an apparent turn and shift of its own.
///
/// # Errors
/// Those of `undo`.
pub fn search(context: &Context, slide: Option<&Slide>, undo: Undo) -> Result<Geometry, DiagnoseError> {
    let mut search = Search::new(context, slide);
    let mut result = ChannelResult::new(Channel::Residuals, search.hold_out.len());
    result.minimum = describe::minimum(&search.sums, &search.select, &search.blocks);
    let mut chosen = search.select(&mut result);
    let sheared = search.take_sheared(&mut chosen);
    if let Some(Sheared { hypothesis, .. }) = &sheared {
        search.is_moved_back = true;
        search.swept = hypothesis.columns().iter().map(|&c| search.sums.columns[c]).collect();
        if search.swept == [Column::Scan] {
            search.swept.push(Column::Uneven);
        }
        search.undo(std::slice::from_ref(hypothesis), undo)?;
        chosen = search.select(&mut result);
    }
    search.add_common_turns(&mut chosen, &mut result);
    search.undo(&chosen.0, undo)?;
    if !chosen.0.is_empty() {
        search.select_beside(&mut chosen, &mut result);
    }
    let (chosen, selected) = search.large_enough(search.still_significant(chosen));
    search.reported = Some(Reported::new(&search, &chosen));
    let gains: Vec<Vec<f64>> = chosen.iter().map(|hypothesis| search.held_out_gains(hypothesis, &chosen)).collect();
    result.distance = search.distances(&chosen, &gains);
    for ((hypothesis, selected), gains) in chosen.iter().zip(selected).zip(gains) {
        result.found.push(describe::found(&search, hypothesis, &chosen, selected, gains));
    }
    let (mut displaced, swept) = (search.displacement(&chosen), search.what_is_swept(&chosen));
    let sums = &search.sums;
    displaced.frames = wandering(search.paired().frames, context.rig, &sums.own_prior, sums.noise_m);
    if let Some(Sheared { hypothesis, selected, gains }) = sheared {
        result.distance.iter_mut().zip(&gains).for_each(|(d, g)| *d = d.map(|nats| nats + g));
        let all = [chosen, vec![hypothesis.clone()]].concat();
        result.found.push(describe::found(&search, &hypothesis, &all, selected, gains));
    }
    Ok(Geometry { result, displaced, swept })
}

impl<'a> Search<'a> {
    fn new(context: &'a Context<'a>, slide: Option<&Slide>) -> Self {
        let swept = slide.map_or(&[][..], Slide::left);
        let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
        Search {
            context,
            is_moved_back: slide.is_some(),
            swept: swept.to_vec(),
            sums: sums(context, &select, &Displacement::default(), swept),
            undone: None,
            blocks: context.blocks(&select),
            estimate_blocks: context.blocks(&estimate),
            demands: first_demands(),
            reported: None,
            returns: context.returns(&select),
            select,
            estimate,
            hold_out,
        }
    }

    /// The frames that the sums are of.
    fn paired(&self) -> Context<'_> {
        Context { frames: self.undone.as_deref().unwrap_or(self.context.frames), ..self.context.clone() }
    }

    /// The displacement by the chosen hypotheses.
    fn displacement(&self, chosen: &[Hypothesis]) -> Displacement {
        displacement(self.context.rig, &self.sums, &self.select, &self.blocks, chosen)
    }

    /// Sums of frames that are paired with the displacement by some hypotheses undone, where there is any.
    fn undo(&mut self, chosen: &[Hypothesis], undo: Undo) -> Result<(), DiagnoseError> {
        let displaced = self.displacement(chosen);
        if displaced.moves()
            || displaced.rows_aim_elsewhere()
            || displaced.bias != [0.0; 2]
            || displaced.drift != [0.0; COURSES]
            || displaced.swept().is_some()
        {
            self.undone = None;
            let frames = undo(&displaced)?;
            let context = Context { frames: &frames, ..self.context.clone() };
            self.sums = sums(&context, &self.select, &displaced, &self.swept);
            self.undone = Some(frames);
        }
        Ok(())
    }

    /// Takes a displacement over a scan out of the chosen hypotheses, where the estimating and the held-out frames
    /// confirm it.
    fn take_sheared(&self, (chosen, selected): &mut Chosen) -> Option<Sheared> {
        let at = chosen.iter().position(|h| h.cause() == Cause::RollingShutter)?;
        let hypothesis = chosen[at].clone();
        let others = chosen.iter().filter(|h| **h != hypothesis).cloned();
        let last: Vec<Hypothesis> = others.chain([hypothesis.clone()]).collect();
        let gains = self.held_out_gains(&hypothesis, chosen);
        let found = describe::found(self, &hypothesis, chosen, selected[at].clone(), gains.clone());
        let large = above_floor(&self.sums, &self.estimate, &self.estimate_blocks, &last);
        (large && is_confirmed(&found)).then(|| {
            chosen.remove(at);
            Sheared { hypothesis, selected: selected.remove(at), gains }
        })
    }

    /// The displacement over a scan by the estimating frames.
    fn what_is_swept(&self, chosen: &[Hypothesis]) -> Option<Swept> {
        let fitted = self.sums.fit_all(&self.estimate, &self.estimate_blocks, chosen);
        let of = |column: Column| self.sums.fitted(&fitted, column).filter(|_| self.swept.contains(&column));
        if let Some(duration) = of(Column::Scan) {
            return Some(Swept::Duration([duration, of(Column::Uneven).unwrap_or_default()]));
        }
        let shear = [0, 1, 2].map(|k| of(Column::Sweep(k)));
        shear.iter().any(Option::is_some).then(|| Swept::Shear(shear.map(Option::unwrap_or_default)))
    }

    /// Cross-validated gains of the selecting frames, nats.
    fn gains(&self, hypotheses: &[Hypothesis]) -> Vec<f64> {
        self.sums.gains(&self.select, &self.blocks, hypotheses)
    }

    /// Gains of the held-out frames by one of the chosen hypotheses, nats.
    fn held_out_gains(&self, hypothesis: &Hypothesis, chosen: &[Hypothesis]) -> Vec<f64> {
        self.sums.gains_of(&self.estimate, &self.estimate_blocks, hypothesis, chosen, &self.hold_out)
    }

    /// Adds turns of the ego vehicle that all other sensors agree on, beside a sensor that is mounted otherwise.
    fn add_common_turns(&self, (chosen, selected): &mut Chosen, result: &mut ChannelResult) {
        let Some(turns) = common_turns(&self.sums, &self.select, &self.blocks, chosen) else { return };
        let with: Vec<Hypothesis> = chosen.iter().cloned().chain([turns.clone()]).collect();
        let before = self.gains(chosen);
        let more: Vec<f64> = self.gains(&with).iter().zip(&before).map(|(g, b)| g - b).collect();
        let (total, z) = total_and_z(&more);
        let enough = total > self.demands.nats && z > self.demands.z;
        if enough && above_floor(&self.sums, &self.select, &self.blocks, &with) {
            result.considered.push(Considered {
                cause: turns.cause().into(),
                channel: result.channel,
                nats_per_ray: total / self.returns,
                z,
                outcome: "chosen: all other sensors see it alike".into(),
            });
            chosen.push(turns);
            selected.push(Selected { rivals: vec![], confidence: 1.0 });
        }
    }

    /// Of each held-out frame its distance, the gain of the chosen hypotheses, and the gain of all columns, nats. The
    /// sums have no distance of their own: it is taken to be the largest gain. `gains` are those of each hypothesis.
    fn distances(&self, chosen: &[Hypothesis], gains: &[Vec<f64>]) -> Vec<[f64; 3]> {
        let (full, base) = self.sums.full_and_base(&self.estimate, &self.estimate_blocks);
        let of_frame = |(i, &f): (usize, &usize)| {
            let grouped = |h: &Hypothesis| matches!(h, Hypothesis::Groups { .. });
            let gain: f64 = gains.iter().map(|g| g[i]).sum();
            let groups: f64 = chosen.iter().zip(gains).filter(|(h, _)| grouped(h)).map(|(_, g)| g[i]).sum();
            let best = full.gain(&self.sums.linear[f]) - base.gain(&self.sums.linear[f]) + groups.max(0.0);
            [best.max(gain).max(0.0), gain, best]
        };
        self.hold_out.iter().enumerate().map(of_frame).collect()
    }
}
