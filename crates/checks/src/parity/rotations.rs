//! Recovers how the reference rounded the sine and cosine of the yaw of each region.
//!
//! PyTorch's vectorised sine and cosine are wrong by one unit in the last place for one argument in fourteen. The
//! second stage samples points by distance in the frame of the region, where this unit decides between points at equal
//! distance. Therefore one region in some hundred has another set of points. Both sets are valid. To compare the
//! following stages, the roundings are derived from the coordinates in the reference.

use super::reference::ReferenceFile;
use anyhow::Result;
use models::pointrcnn::RoiHeadConfig;
use models::pointrcnn::roi_input::{RoiInput, Scene};

/// Positions of the centres of the second stage for each level, in the frame of the region, m. The regions are
/// concatenated, with repeated points as in the reference.
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

/// Sine and cosine of the yaw of each region, exact or changed by one unit in the last place: the choice that
/// reproduces most coordinates in `rcnn_sa0.xyz` exactly. `first` is the number of the first region in the file.
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
            // Indices of the coordinates of this region in the whole tensor, as far as the file contains them.
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

/// The float that is `steps` units in the last place farther from zero.
fn next(value: f32, steps: i32) -> f32 {
    f32::from_bits(value.to_bits().wrapping_add_signed(steps))
}
