//! How the reference rounded the sine and cosine of a region's yaw.
//!
//! PyTorch's vectorised sine and cosine are off by one in the last digit for one argument in fourteen. The second stage samples points by
//! distance in the region's frame, where that digit decides between points equally far apart: one region in some hundred gets another set of
//! points. Nothing is wrong with either; to compare what comes after, the roundings are read off the reference's own coordinates.

use super::reference::ReferenceFile;
use anyhow::Result;
use models::config::RoiHeadConfig;
use models::pointrcnn::roi_input::{RoiInput, Scene};

/// Positions of the second stage's centres, level by level, in the region's frame, m; regions one after the other, with repetitions as in
/// the reference.
pub fn centers(input: &RoiInput) -> Vec<Vec<[f32; 3]>> {
    let regions = input.regions();
    let position = |row: &u32| std::array::from_fn(|axis| input.prefix[*row as usize][axis]);
    let mut above: Vec<[f32; 3]> = input.dense[0].iter().map(position).collect();
    let mut levels = Vec::new();
    for picks in &input.picks {
        let (from, here) = (above.len() / regions, picks.len() / regions);
        above = picks.iter().enumerate().map(|(k, &pick)| above[k / here * from + pick as usize]).collect();
        levels.push(above.clone());
    }
    levels
}

/// Sine and cosine of each region's yaw, exact or off by one in the last digit, whichever gives most of the coordinates in `rcnn_sa0.xyz` to the
/// last bit. `first` is the number of the first region in the file.
pub fn reference_rotations(
    file: &mut ReferenceFile,
    scene: Scene<'_>,
    rois: &[[f32; 7]],
    first: usize,
    config: &RoiHeadConfig,
) -> Result<Vec<[f32; 2]>> {
    let exact: Vec<[f32; 2]> = rois.iter().map(|roi| roi[6].sin_cos().into()).collect();
    let (reference, step) = file.sampled("rcnn_sa0.xyz")?;
    let mut best: Vec<(usize, [f32; 2])> = exact.iter().map(|r| (0, *r)).collect();
    for (sin_off, cos_off) in [(0, 0), (0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)] {
        let rotations: Vec<[f32; 2]> = exact.iter().map(|&[s, c]| [next(s, sin_off), next(c, cos_off)]).collect();
        let input = RoiInput::rotated(scene, rois, &rotations, config);
        let ours = &centers(&input)[0];
        let values = ours.as_flattened();
        let of_region = values.len() / rois.len().max(1);
        for (r, best) in best.iter_mut().enumerate() {
            // Numbers of this region's coordinates in the whole tensor that the file holds.
            let (from, to) = ((first + r) * of_region, (first + r + 1) * of_region);
            let equal = (from.div_ceil(step)..to.div_ceil(step))
                .filter(|k| reference.get(*k) == Some(&values[k * step - first * of_region]))
                .count();
            if equal > best.0 {
                *best = (equal, rotations[r]);
            }
        }
    }
    Ok(best.into_iter().map(|(_, rotation)| rotation).collect())
}

/// The float `steps` places farther from zero.
fn next(value: f32, steps: i32) -> f32 {
    f32::from_bits(value.to_bits().wrapping_add_signed(steps))
}
