//! The backbone (Qi et al. 2017, PointNet++; OpenPCDet: `PointNet2MSG`).

use super::config::PointRcnnConfig;
use super::hierarchy::Hierarchy;
use super::set_abstraction::SharedMlp;
use crate::kernel_ops::MlpRows;
use crate::layers::{BatchNorm, Init, Mode, RowCounts, RowsBnRelu, rows_kernel};
use crate::point_ops::{Groups, Interpolation, InterpolationTensors, interpolate};
use burn::module::Module;
use burn::tensor::{Device, Tensor};

/// Set abstraction to ever fewer points, and feature propagation back to all points.
#[derive(Module, Debug)]
pub struct PointNet2Msg {
    /// Finest first.
    pub sa_modules: Vec<SetAbstraction>,
    /// Finest first; the coarsest runs first.
    pub fp_modules: Vec<FeaturePropagation>,
}

/// One level of set abstraction with multi-scale grouping.
#[derive(Module, Debug)]
pub struct SetAbstraction {
    /// The layers of each scale.
    pub mlps: Vec<SharedMlp>,
}

/// Feature propagation from the points of one level to those of the next finer one.
#[derive(Module, Debug)]
pub struct FeaturePropagation {
    /// The layers.
    pub mlp: Vec<RowsBnRelu<4>>,
}

/// Intermediate outputs of the backbone. The clouds of a batch are concatenated.
#[derive(Clone, Debug)]
pub struct BackboneStages {
    /// Output of each level of set abstraction, `[B * M, C]`.
    pub set_abstraction: Vec<Tensor<2>>,
    /// Output of each feature propagation, finest first, `[B * U, C]`.
    pub propagation: Vec<Tensor<2>>,
}

impl PointNet2Msg {
    /// For points with `inputs` values in addition to their coordinates.
    pub fn new(inputs: usize, net: &PointRcnnConfig, init: &Init<'_>) -> Self {
        let norm = |channels| BatchNorm::new(channels, 0.1, 1e-5, init);
        let mut channels = vec![inputs];
        let mut sa_modules = Vec::new();
        for (i, level) in net.levels.iter().enumerate() {
            let from = channels[i];
            let mlp = |(g, filters): (usize, &[usize])| {
                let name = format!("backbone_3d.SA_modules.{i}.mlps.{g}");
                SharedMlp::new(from, filters, |j, c| {
                    RowsBnRelu::new(&format!("{name}.{}.weight", 3 * j), c, norm(c[1]), init)
                })
            };
            let scales = level.scales.iter().map(|s| s.filters.as_slice());
            sa_modules.push(SetAbstraction { mlps: scales.clone().enumerate().map(mlp).collect() });
            channels.push(scales.map(|filters| filters[filters.len() - 1]).sum());
        }
        // Level i + 1 is interpolated, level i is the skip connection.
        let mut known = channels[channels.len() - 1];
        let mut fp_modules = Vec::new();
        for (i, filters) in net.propagation.iter().enumerate().rev() {
            let mut from = known + channels[i];
            let mut mlp = Vec::new();
            for (j, &filters) in filters.iter().enumerate() {
                let name = format!("backbone_3d.FP_modules.{i}.mlp.{}.weight", 3 * j);
                mlp.push(RowsBnRelu::new(&name, [from, filters], norm(filters), init));
                from = filters;
            }
            known = from;
            fp_modules.push(FeaturePropagation { mlp });
        }
        fp_modules.reverse();
        PointNet2Msg { sa_modules, fp_modules }
    }

    /// # Shapes
    /// `features`: `[B * N, C]`, the values of the points besides their coordinates; `None` if there are none.
    /// `propagation[0]` of the result: `[B * N, C']`.
    pub fn forward(
        &self,
        features: Option<Tensor<2>>,
        clouds: &[&Hierarchy],
        device: &Device,
        mode: Mode,
    ) -> BackboneStages {
        let sizes = |level: usize, cloud: &Hierarchy| match level {
            0 => cloud.up[0].source.len() as u32,
            _ => cloud.levels[level - 1].points.len() as u32,
        };
        let mut down = vec![features];
        for (i, module) in self.sa_modules.iter().enumerate() {
            let scales = module.mlps.iter().enumerate().map(|(g, mlp)| {
                let mut groups = Groups::default();
                let mut first_row = 0;
                for cloud in clouds {
                    groups.append(&cloud.levels[i].scales[g], first_row);
                    first_row += sizes(i, cloud);
                }
                mlp.forward(down[i].clone(), groups, device, mode)
            });
            down.push(Some(Tensor::cat(scales.collect(), 1))); // [B * M, sum of the scales' channels]
        }
        let set_abstraction: Vec<Tensor<2>> = down[1..].iter().flatten().cloned().collect();
        let mut known = set_abstraction[set_abstraction.len() - 1].clone();
        let mut propagation = Vec::new();
        for (i, module) in self.fp_modules.iter().enumerate().rev() {
            let mut from = Interpolation::default();
            let mut first_row = 0;
            for cloud in clouds {
                from.append(&cloud.up[i], first_row);
                first_row += sizes(i + 1, cloud);
            }
            known = module.forward(known, down[i].clone(), &from.to_device(device), mode);
            propagation.push(known.clone());
        }
        propagation.reverse();
        BackboneStages { set_abstraction, propagation }
    }
}

impl FeaturePropagation {
    /// Applies the layers to interpolated features concatenated with the points' features. The first layer's product
    /// with the former is computed before the interpolation, where there are fewer points; this is equivalent because
    /// both are linear.
    ///
    /// # Shapes
    /// `known`: `[K, C1]`, `own`: `[U, C2]`; result `[U, C']`.
    pub fn forward(
        &self,
        known: Tensor<2>,
        own: Option<Tensor<2>>,
        from: &InterpolationTensors,
        mode: Mode,
    ) -> Tensor<2> {
        let (first, rest) = (&self.mlp[0], &self.mlp[1..]);
        let interpolated = known.dims()[1];
        let mut y = interpolate(first.project(known, 0), from); // [U, C]
        if let Some(own) = own {
            y = y + first.project(own, interpolated);
        }
        rows_kernel(&self.mlp, &MlpRows::Projected(y.clone()), None, mode).unwrap_or_else(|| {
            let counts = RowCounts::once(y.dims()[0], &y.device());
            let x = first.norm_relu(y, &counts, mode);
            rest.iter().fold(x, |x, layer| layer.forward(x, &counts, mode))
        })
    }
}
