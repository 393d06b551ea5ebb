//! The gain of an unpaired comparison: frames of the simulation are made anew with the list of effects, and the same
//! distances are measured again.

use super::{Contexts, Pairs, Unpaired, kinds};
use crate::catalogue::Channel;
use crate::diagnosis::{Gain, NotApplied};
use crate::engine::{Distances, GainFrames, Remake};
use crate::error::DiagnoseError;
use crate::inference::roles::Role;
use crate::pairing::{FrameAlone, in_order};
use crate::search::{hits, mask, noise, quantisation, returns};
use rayon::prelude::*;
use sensor::EffectList;
use std::collections::BTreeSet;

/// The distances of both sides by channel: what tables of the measured side, from the `train` frames, predict better of
/// the `test` frames than the simulation does, nats.
fn distances(contexts: &Contexts, train: &[usize], test: &[usize]) -> Distances {
    let lost = hits::by_cell(&contexts.shots, train, test);
    let cut = mask::cut_by_table(&contexts.returns, train, test);
    Distances::from([
        (Channel::Hits, lost.into_iter().zip(cut).map(|(lost, cut)| lost + cut).collect()),
        (Channel::Roughness, noise::by_table(&contexts.returns, train, test)),
        (Channel::Returns, returns::kinds_by_table(&contexts.returns, kinds(&contexts.returns), train, test)),
        (Channel::Ranges, quantisation::by_table(&contexts.returns, train, test)),
    ])
}

/// The gain of a list of effects in the channels in which something was found. Without a list, the distances alone.
pub(super) fn gain(
    unpaired: &Unpaired,
    found: BTreeSet<Channel>,
    effects: Option<&EffectList>,
    remake: &dyn Remake,
) -> Result<Gain, DiagnoseError> {
    let pairs = unpaired.pairs(unpaired.measured.clone(), unpaired.simulated.clone());
    let contexts = unpaired.contexts(&pairs);
    let [train, test] = [Role::Estimate, Role::HoldOut].map(|role| contexts.returns.of(role));
    let of = |contexts: &Contexts| distances(contexts, &train, &test);
    let before = of(&contexts);
    let frames = GainFrames { returns: contexts.returns.returns(&test), blocks: contexts.returns.blocks(&test) };
    let Some(effects) = effects else {
        return Ok(Gain {
            before: 0.0,
            after: 0.0,
            floor: 0.0,
            ..frames.gain([&before, &before, &before], &found, false)
        });
    };
    let (made, refused) = remake.with(effects)?;
    let none_applied = refused.len() == effects.effects.len();
    let not_applied = refused.into_iter().map(|r| NotApplied { effect: r.kind.into(), why: r.why }).collect();
    let zero: Distances = before.iter().map(|(c, d)| (*c, vec![0.0; d.len()])).collect();
    if none_applied {
        return Ok(Gain { not_applied, ..frames.gain([&before, &before, &zero], &found, true) });
    }
    let two = |(number, id): (usize, &String)| -> Result<[FrameAlone; 2], DiagnoseError> {
        let frames = made.frame(id)?;
        Ok(frames.map(|(cloud, objects)| unpaired.side.remade(&cloud, objects, &unpaired.recorded, number)))
    };
    let (one, other): (Vec<FrameAlone>, Vec<FrameAlone>) =
        in_order(unpaired.side.ids.par_iter().enumerate().map(two))?.into_iter().map(|[a, b]| (a, b)).unzip();
    let after: Pairs = unpaired.pairs(unpaired.measured.clone(), one.clone());
    // Two draws of the extended simulation, half of the drive apart: other places as well.
    let mut elsewhere = other;
    elsewhere.rotate_left(unpaired.ids.len() / 2);
    let floor: Pairs = unpaired.pairs(elsewhere, one);
    let [after, floor] = [after, floor].map(|pairs| of(&unpaired.contexts(&pairs)));
    Ok(Gain { not_applied, ..frames.gain([&before, &after, &floor], &found, true) })
}
