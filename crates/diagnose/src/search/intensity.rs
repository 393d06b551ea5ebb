//! Intensities: the law by which measured ones follow simulated ones, and a gain of each row beyond it.

mod law;
mod rows;

use super::{ChannelResult, Context, Found};
use crate::catalogue::{Channel, Covariate};
use crate::channels::intensity::{BRIGHTNESS, COLUMNS, Column, Sample, Scale, columns};
use crate::curve::Curve;
use crate::diagnosis::Status;
use crate::inference::grouped::GroupFit;
use crate::inference::linear::LinearFrame;
use crate::inference::roles::Role;
use crate::pairing::FramePair;
use rayon::prelude::*;

/// Spread of the intensities of surfaces, ln, of a sensor whose response is linear. One that is logarithmic has a
/// quarter of it, and gains of the light are a quarter as large there.
const USUAL_SPREAD: f64 = 0.8;

/// Prior precisions of the columns: none, but for what keeps sums without a kind of surface solvable.
const PRIOR: [f64; COLUMNS] = [1e-6; COLUMNS];

/// Gains of rows: prior standard deviation 0.3; their mean belongs to the factor of all.
const ROWS: GroupFit = GroupFit { column: 0, precision: 11.0, centred: true, trust: 1.0 };

/// The search. What cannot be compared is said in `notes`.
pub fn search(context: &Context, notes: &mut Vec<String>) -> ChannelResult {
    let mut result = ChannelResult::new(Channel::Intensity, context.of(Role::HoldOut).len());
    let Some(both) = columns(context.frames) else { return result };
    if let Some(says) = without_relation(&both) {
        match both.map(|c| c.tells_surfaces()) {
            [false, false] => notes.push(says),
            _ => result.found.push(unrelated(context, says)),
        }
        return result;
    }
    let select: Vec<&FramePair> = context.of(Role::Select).into_iter().map(|i| &context.frames[i]).collect();
    let Some(scale) = Scale::new(&select, both) else {
        notes.push("too few intensities are neither saturated nor below a few steps: they are not compared".into());
        return result;
    };
    Search::new(context, &scale).run(&mut result, notes);
    result
}

/// Gains of the `test` frames by tables of intensities fitted on the `train` frames, nats.
pub fn by_table(context: &Context, train: &[usize], test: &[usize]) -> Vec<f64> {
    let frames = |which: &[usize]| -> Vec<&FramePair> { which.iter().map(|&i| &context.frames[i]).collect() };
    let (train, test) = (frames(train), frames(test));
    let of_surfaces = columns(context.frames).filter(|both| both.iter().all(Column::tells_surfaces));
    match of_surfaces.and_then(|both| Scale::new(&train, both)) {
        Some(scale) => scale.by_table(&train, &test),
        None => vec![0.0; test.len()],
    }
}

/// Why the intensities of the two sides are not related, where they are not.
fn without_relation(both: &[Column; 2]) -> Option<String> {
    let what =
        |c: &Column| if c.constant { "are all the same" } else { "do not depend on the surface: they are noise" };
    let [measured, simulated] = both;
    Some(match [measured.tells_surfaces(), simulated.tells_surfaces()] {
        [true, true] => return None,
        [false, true] => format!("measured intensities {}; simulated ones tell surfaces apart", what(measured)),
        [true, false] => format!("simulated intensities {}; measured ones tell surfaces apart", what(simulated)),
        [false, false] => format!(
            "intensities are not compared: measured ones {}, simulated ones {}",
            what(measured),
            what(simulated)
        ),
    })
}

/// The finding of a side whose intensities tell nothing.
fn unrelated(context: &Context, says: String) -> Found {
    Found {
        status: Status::Unexplained,
        causes: vec![],
        parameters: vec![],
        confidence: 1.0,
        channel: Channel::Intensity,
        covariate: Covariate::None,
        held_out_gains: vec![0.0; context.of(Role::HoldOut).len()],
        says,
        separate_by: None,
        curve: Curve::default(),
        effects: vec![],
    }
}

struct Search<'a> {
    context: &'a Context<'a>,
    scale: &'a Scale,
    /// Sums of all frames.
    sums: Vec<LinearFrame>,
    /// The same within rows, where rows have gains of their own: those follow ranges and angles as a law does.
    within_rows: Option<Vec<LinearFrame>>,
    /// Error of the factor by the gains of rows, ln.
    of_rows: f64,
    select: Vec<usize>,
    estimate: Vec<usize>,
    hold_out: Vec<usize>,
}

impl<'a> Search<'a> {
    fn new(context: &'a Context<'a>, scale: &'a Scale) -> Self {
        let sums = context.frames.par_iter().map(|f| scale.sums(&f.measured)).collect();
        let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
        Search { context, scale, sums, within_rows: None, of_rows: 0.0, select, estimate, hold_out }
    }

    /// Sums of some frames, by which exponents are fitted, with their blocks.
    fn of<'b>(&'b self, which: &[usize]) -> (Vec<&'b LinearFrame>, Vec<usize>) {
        let sums = self.within_rows.as_ref().unwrap_or(&self.sums);
        (which.iter().map(|&i| &sums[i]).collect(), self.context.blocks(which))
    }

    fn run(mut self, result: &mut ChannelResult, notes: &mut Vec<String>) {
        let considered = result.considered.len();
        let mut law = self.form(result).map(|form| self.law(&self.estimate, &form));
        if let Some([std, rows]) = self.rows_differ(law.as_ref()) {
            let sums = |f: &FramePair| self.scale.sums_within_rows(&f.measured);
            self.within_rows = Some(self.context.frames.par_iter().map(sums).collect());
            self.of_rows = std / rows.max(1.0).sqrt();
            result.considered.truncate(considered);
            result.minimum.clear();
            law = self.form(result).map(|form| self.law(&self.estimate, &form));
        }
        let of_law = |s: &Sample| law.as_ref().map_or(0.0, |law| law.of(s));
        let mut gained = vec![0.0; self.hold_out.len()];
        if let Some(law) = &law {
            let gains = self.gains_of(law);
            gained.iter_mut().zip(&gains).for_each(|(sum, g)| *sum += g);
            result.found.push(self.law_found(law, gains));
        }
        let rows = self.scale.rows(self.context.frames, self.context.rig, &of_law);
        let gamma = 1.0 + law.as_ref().map_or(0.0, |law| law.coefficient(BRIGHTNESS)[0]);
        if let Some(found) = self.rows_found(&rows, gamma, result) {
            gained.iter_mut().zip(&found.held_out_gains).for_each(|(sum, g)| *sum += g);
            result.found.push(found);
        }
        notes.extend(self.world(law.as_ref().map_or(&[], |law| &law.exponents)));
        let frames = |which: &[usize]| which.iter().map(|&i| &self.context.frames[i]).collect::<Vec<_>>();
        let tables = self.scale.by_table(&frames(&self.estimate), &frames(&self.hold_out));
        result.distance = gained.iter().zip(tables).map(|(g, t)| [g.max(t), *g, t]).collect();
    }
}
