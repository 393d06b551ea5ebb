//! The pillar feature net by the kernels.

use super::operation::{Argument, Operation, run};
use super::{algorithm, moments};
use crate::layers::Moments;
use burn::tensor::Tensor;
use kernels::{PillarNet, PillarParameters, PillarState, Pillars};
use std::sync::Arc;

/// Linear, batch norm over all rows with the padding, ReLU, maximum; the statistics are returned for the running ones.
///
/// # Shapes
/// `features`: `[N, F]`; `weight`: `[C, F]`; `gamma`, `beta`: `[C]`; result `[P, C]`. `None` where there is no kernel.
pub fn pillar_net(
    (features, num_points): (&Tensor<2>, &[u32]),
    weight: &Tensor<2>,
    (gamma, beta): (&Tensor<1>, &Tensor<1>),
    (max_points, epsilon): (usize, f64),
) -> Option<(Tensor<2>, Moments)> {
    algorithm()?;
    let [outputs, inputs] = weight.dims();
    if inputs > kernels::pillar_net::MOST_INPUTS {
        return None;
    }
    let net = PillarNet { inputs, outputs, max_points, epsilon };
    let operation = OnPillars { net, num_points: num_points.into() };
    let arguments = [Argument::of(features)?, Argument::of(weight)?, Argument::of(gamma)?, Argument::of(beta)?];
    let (y, state) = run(operation, arguments)?;
    let moments = moments(&state.statistics, state.count, &y.device());
    Some((y, moments))
}

#[derive(Clone, Debug)]
struct OnPillars {
    net: PillarNet,
    num_points: Arc<[u32]>,
}

impl Operation<4> for OnPillars {
    type State = PillarState;

    fn forward(&self, [features, weight, gamma, beta]: [&[f32]; 4]) -> (Vec<f32>, Vec<usize>, PillarState) {
        let mut out = Vec::new();
        let pillars = Pillars { features, num_points: &self.num_points };
        let state = self.net.forward_train(pillars, PillarParameters { weight, gamma, beta }, &mut out);
        (out, vec![self.num_points.len(), self.net.outputs], state)
    }

    /// The points are data: there is no gradient by them.
    fn backward(
        &self,
        [features, weight, gamma, beta]: [&[f32]; 4],
        state: &PillarState,
        gradient: &[f32],
        _: [bool; 4],
    ) -> [Option<Vec<f32>>; 4] {
        let pillars = Pillars { features, num_points: &self.num_points };
        let g = self.net.backward(pillars, PillarParameters { weight, gamma, beta }, state, gradient);
        [None, Some(g.weight), Some(g.gamma), Some(g.beta)]
    }
}
