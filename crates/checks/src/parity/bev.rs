//! Comparison of the networks on pillars with reference values: what they share in front of their heads.

use super::manifest::{Manifest, array, floats, usizes};
use super::network::{Case, wide};
use super::reference::ReferenceFile;
use anyhow::{Result, ensure};
use burn::tensor::Tensor;
use models::bev::pillars::Pillars;
use models::bev::{BackboneConfig, BevStages, PillarsConfig};
use models::layers::host;

/// The pillars of the manifest.
pub fn pillar_sizes(manifest: &Manifest) -> Result<PillarsConfig> {
    let default = PillarsConfig::default();
    Ok(PillarsConfig {
        size_m: array(&manifest.voxel_size)?,
        max_points: manifest.max_points_per_pillar,
        max_train: manifest.max_pillars.unwrap_or(default.max_train),
        max_test: manifest.max_pillars.unwrap_or(default.max_test),
    })
}

/// The channels of the layers of the pillar feature net. Only the features that this program computes are supported.
pub fn vfe_filters(manifest: &Manifest) -> Result<Vec<usize>> {
    let vfe = &manifest.model_cfg["VFE"];
    for (key, needed) in [("WITH_DISTANCE", false), ("USE_ABSLOTE_XYZ", true), ("USE_NORM", true)] {
        let given = vfe[key].as_bool().unwrap_or(needed);
        ensure!(given == needed, "manifest.json: VFE.{key} = {given} is not supported");
    }
    usizes(&vfe["NUM_FILTERS"])
}

/// The backbone of the manifest.
pub fn backbone(manifest: &Manifest) -> Result<BackboneConfig> {
    let backbone = &manifest.model_cfg["BACKBONE_2D"];
    Ok(BackboneConfig {
        layers: usizes(&backbone["LAYER_NUMS"])?,
        strides: usizes(&backbone["LAYER_STRIDES"])?,
        filters: usizes(&backbone["NUM_FILTERS"])?,
        upsample_strides: floats(&backbone["UPSAMPLE_STRIDES"])?.into_iter().map(|v| v as f32).collect(),
        upsample_filters: usizes(&backbone["NUM_UPSAMPLE_FILTERS"])?,
    })
}

/// Compares the cells and point counts of the pillars of a batch.
pub fn pillars(file: &mut ReferenceFile, frames: &[&Pillars]) -> Result<()> {
    let mut coords = Vec::new();
    for (b, pillars) in frames.iter().enumerate() {
        coords.extend(pillars.coords_zyx.iter().flat_map(|&[z, y, x]| [b as u32, z, y, x]).map(f64::from));
    }
    file.compare("pillar.coords_bzyx", &coords, 0.0)?;
    let counts: Vec<f64> = frames.iter().flat_map(|p| p.num_points.iter().map(|&n| f64::from(n))).collect();
    file.compare("pillar.num_points", &counts, 0.0)
}

/// Compares a stage that has the reference's shape.
pub fn stage<const D: usize>(
    case: &Case,
    file: &mut ReferenceFile,
    mode: &str,
    name: &str,
    tensor: &Tensor<D>,
) -> Result<()> {
    let tolerance = case.tolerance(&format!("{mode}/{name}"));
    file.compare_stage(name, &wide(&host(tensor.clone())?), &tensor.dims(), tolerance)
}

/// Compares the stages in front of the head.
pub fn stages(case: &Case, file: &mut ReferenceFile, mode: &str, stages: &BevStages) -> Result<()> {
    stage(case, file, mode, "pillar_features", &stages.canvas.features)?;
    let image = stages.canvas.image();
    let mut maps = vec![("spatial_features".to_string(), &image)];
    maps.extend(stages.backbone.blocks.iter().enumerate().map(|(i, t)| (format!("block{i}"), t)));
    maps.extend(stages.backbone.deblocks.iter().enumerate().map(|(i, t)| (format!("deblock{i}"), t)));
    maps.push(("spatial_features_2d".to_string(), &stages.backbone.spatial_features_2d));
    for (name, tensor) in maps {
        stage(case, file, mode, &name, tensor)?;
    }
    Ok(())
}
