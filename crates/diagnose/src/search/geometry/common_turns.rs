//! Pitch and roll of the ego vehicle beside one sensor that is mounted otherwise than the rig says: turns that all
//! other sensors see alike.

use super::hypotheses::Hypothesis;
use super::sums::Sums;
use crate::catalogue::Cause;
use crate::catalogue::sizes::TURN_RAD;
use crate::channels::mean::Column;
use crate::channels::own_poses::OwnPoses;
use crate::search::Z_STAR;

/// Turns of the other sensors agree if the smallest is at least this share of the largest.
const ALIKE: f64 = 0.5;

/// Turns of the whole scene as a hypothesis, where a sensor's pose was chosen and at least two other sensors agree on
/// the turns.
pub(super) fn common_turns(
    sums: &Sums,
    select: &[usize],
    blocks: &[usize],
    chosen: &[Hypothesis],
) -> Option<Hypothesis> {
    if chosen.iter().any(|c| c.cause() == Cause::PitchRoll) {
        return None;
    }
    let sensor = chosen.iter().find_map(|c| match c {
        Hypothesis::Linear { columns, .. } => columns.iter().find_map(|&c| match sums.columns[c] {
            Column::SensorPose(sensor, _) => Some(sensor),
            _ => None,
        }),
        Hypothesis::Groups { .. } => None,
    })?;
    let turns = alike(&sums.poses, select, blocks, sensor);
    let column = |turn: usize| sums.columns.iter().position(|c| *c == Column::Pose(turn));
    let columns: Vec<usize> = turns.into_iter().filter_map(column).collect();
    (!columns.is_empty()).then_some(Hypothesis::Linear { cause: Cause::PitchRoll, columns })
}

/// Those of the turns about x and y that all sensors but one see alike, each significantly and by more than the floor.
fn alike(poses: &[OwnPoses], select: &[usize], blocks: &[usize], except: usize) -> Vec<usize> {
    let others: Vec<usize> = (0..poses.first().map_or(0, Vec::len)).filter(|s| *s != except).collect();
    if others.len() < 2 {
        return vec![];
    }
    let members = statistics::blocks_of(blocks);
    let mean_and_error = |sensor: usize, turn: usize| {
        let mean =
            |which: &[usize]| which.iter().map(|&i| poses[select[i]][sensor][turn]).sum::<f64>() / which.len() as f64;
        let means: Vec<f64> = members.iter().map(|m| mean(m)).collect();
        let n = means.len() as f64;
        let middle = means.iter().sum::<f64>() / n;
        let variance = means.iter().map(|m| (m - middle).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
        (middle, (variance / n).sqrt())
    };
    let agrees = |turn: &usize| {
        let seen: Vec<(f64, f64)> = others.iter().map(|&s| mean_and_error(s, *turn)).collect();
        let sure = seen.iter().all(|(m, e)| m.abs() > Z_STAR * e && m.abs() > TURN_RAD && m * seen[0].0 > 0.0);
        let sizes = || seen.iter().map(|(m, _)| m.abs());
        sure && sizes().fold(f64::INFINITY, f64::min) > ALIKE * sizes().fold(0.0, f64::max)
    };
    (0..2).filter(agrees).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::SVector;

    #[test]
    fn turns_that_all_others_see_alike_belong_to_the_ego_vehicle() {
        let pitch = |of_third: f64| -> Vec<OwnPoses> {
            (0..24)
                .map(|f| {
                    let own = 2e-4 * (f64::from(f * 7 % 24) / 12.0 - 1.0);
                    let pose = |pitch: f64| SVector::from_fn(|k, _| if k == 1 { pitch + own } else { 0.0 });
                    vec![pose(0.002), pose(0.009), pose(of_third)]
                })
                .collect()
        };
        let select: Vec<usize> = (0..24).collect();
        let blocks: Vec<usize> = (0..24).map(|f| f / 4).collect();
        assert_eq!(alike(&pitch(0.0018), &select, &blocks, 1), [1]);
        for other in [0.0, -0.002, 0.0006] {
            assert!(alike(&pitch(other), &select, &blocks, 1).is_empty(), "{other}");
        }
        assert!(alike(&pitch(0.0018), &select, &blocks, 0).is_empty(), "0.009 and 0.0018");
    }
}
