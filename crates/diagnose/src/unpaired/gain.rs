//! The gain of an unpaired comparison: frames of the simulation are made anew with the list of effects, and the same
//! distances are measured again.

use super::sides::as_pairs;
use super::{Contexts, Unpaired};
use crate::catalogue::{Channel, Kind};
use crate::diagnosis::{Gain, NotApplied};
use crate::engine::{Distances, GainFrames, Remake, of_channels};
use crate::error::DiagnoseError;
use crate::inference::roles::Role;
use crate::pairing::{FrameAlone, in_order};
use crate::search::{hits, mask, mixed_pixels, noise, quantisation, returns};
use rayon::prelude::*;
use sensor::EffectList;
use std::collections::BTreeSet;

/// The distances of both sides by channel: what tables of the measured side, from the `train` frames, predict better of
/// the `test` frames than the simulation does, nats.
fn distances(contexts: &Contexts, train: &[usize], test: &[usize]) -> Distances {
    let lost = hits::by_cell(&contexts.shots, train, test);
    let cut = mask::cut_by_table(&contexts.returns, train, test);
    let others = [
        (Channel::Roughness, noise::by_table(&contexts.returns, train, test)),
        (Channel::Ranges, quantisation::by_table(&contexts.returns, train, test)),
    ];
    let mut all = returns::by_table_of_streets(&contexts.returns, train, test);
    all.insert(Kind::Between, mixed_pixels::by_table(&contexts.returns, train, test));
    all.insert(Kind::Surfaces, lost.into_iter().zip(cut).map(|(lost, cut)| lost + cut).collect());
    of_channels(others, all)
}

/// Distances as they were recorded, and those of frames that are made anew.
pub(super) struct Verification<'a> {
    unpaired: &'a Unpaired<'a>,
    train: Vec<usize>,
    test: Vec<usize>,
    frames: GainFrames,
    before: Distances,
}

impl<'a> Verification<'a> {
    /// Of both sides as they were recorded.
    pub(super) fn new(unpaired: &'a Unpaired<'a>, recorded: &Contexts) -> Self {
        let returns = &recorded.returns;
        let [train, test] = [Role::Estimate, Role::HoldOut].map(|role| returns.of(role));
        let frames = GainFrames { returns: returns.returns(&test), blocks: returns.blocks(&test) };
        let before = distances(recorded, &train, &test);
        Verification { unpaired, train, test, frames, before }
    }

    /// The gain of a list of effects in the channels in which something was found. Without a list, the distances alone.
    pub(super) fn of(
        &self,
        found: &BTreeSet<Channel>,
        effects: Option<&EffectList>,
        remake: &dyn Remake,
    ) -> Result<Gain, DiagnoseError> {
        let (before, unpaired) = (&self.before, self.unpaired);
        let Some(effects) = effects else {
            let gain = self.frames.gain([before; 3], found, false);
            return Ok(Gain { before: 0.0, after: 0.0, floor: 0.0, ..gain });
        };
        let (made, refused) = remake.with(effects)?;
        let none_applied = refused.len() == effects.effects.len();
        let not_applied = refused.into_iter().map(|r| NotApplied { effect: r.kind.into(), why: r.why }).collect();
        if none_applied {
            let zero: Distances = before.iter().map(|(c, d)| (*c, vec![0.0; d.len()])).collect();
            return Ok(Gain { not_applied, ..self.frames.gain([before, before, &zero], found, true) });
        }
        let two = |(number, id): (usize, &String)| -> Result<[FrameAlone; 2], DiagnoseError> {
            let frames = made.frame(id)?;
            Ok(frames.map(|(cloud, objects)| unpaired.side.remade(&cloud, objects, &unpaired.recorded, number)))
        };
        let (one, other): (Vec<FrameAlone>, Vec<FrameAlone>) =
            in_order(unpaired.side.ids.par_iter().enumerate().map(two))?.into_iter().map(|[a, b]| (a, b)).unzip();
        let after = unpaired.pairs(one.clone());
        // Two draws of the extended simulation, half of the drive apart: other places as well.
        let mut elsewhere = other;
        elsewhere.rotate_left(unpaired.ids.len() / 2);
        let floor = as_pairs(&unpaired.ids, [elsewhere, one]);
        let [after, floor] = [after, floor].map(|p| distances(&unpaired.contexts(&p), &self.train, &self.test));
        Ok(Gain { not_applied, ..self.frames.gain([before, &after, &floor], found, true) })
    }
}
