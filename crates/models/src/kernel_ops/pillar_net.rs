//! The pillar feature net as one operation; the points are data and have no gradient.

use super::{Input, Kernel, apply, input};
use burn::tensor::Tensor;
use kernels::{PillarNet, PillarParameters, PillarState, Pillars, Statistics};
use std::sync::Arc;

#[derive(Clone, Debug)]
struct PillarKernel {
    net: PillarNet,
    features: Arc<[f32]>,
    num_points: Arc<[u32]>,
    /// Running statistics, for inference.
    statistics: Option<Statistics>,
}

impl PillarKernel {
    fn pillars(&self) -> Pillars<'_> {
        Pillars { features: &self.features, num_points: &self.num_points }
    }
}

impl Kernel<3> for PillarKernel {
    /// `None` at inference.
    type State = Option<Arc<PillarState>>;

    fn forward(&self, [weight, gamma, beta]: [&[f32]; 3]) -> (Vec<f32>, Self::State) {
        let parameters = PillarParameters { weight, gamma, beta };
        let mut out = Vec::new();
        let state = match &self.statistics {
            None => Some(Arc::new(self.net.forward_train(self.pillars(), parameters, &mut out))),
            Some(statistics) => {
                self.net.forward(self.pillars(), parameters, statistics, &mut out);
                None
            }
        };
        (out, state)
    }

    fn backward(
        &self,
        [weight, gamma, beta]: [&[f32]; 3],
        state: &Self::State,
        dy: &[f32],
        _: [bool; 3],
    ) -> [Option<Vec<f32>>; 3] {
        let state = state.as_ref().expect("only training has a backward pass");
        let found = self.net.backward(self.pillars(), PillarParameters { weight, gamma, beta }, state, dy);
        [Some(found.weight), Some(found.gamma), Some(found.beta)]
    }

    fn shape(&self) -> Vec<usize> {
        vec![self.num_points.len(), self.net.outputs]
    }
}

/// The points of all pillars of a batch on the host: `[N, F]`, and the number of points of each pillar, `[P]`.
type Points = (Arc<[f32]>, Arc<[u32]>);

/// Features of all pillars, the statistics over all rows (padding included), and the number of these rows.
///
/// # Shapes
/// `weight`: `[C, F]`; `gamma`, `beta`: `[C]`; result `[P, C]`.
pub fn pillar_net(
    (features, num_points): Points,
    (weight, gamma, beta): (&Tensor<2>, &Tensor<1>, &Tensor<1>),
    max_points: usize,
    epsilon: f64,
) -> Option<(Tensor<2>, Statistics, usize)> {
    let net = net(weight, max_points, epsilon)?;
    let kernel = PillarKernel { net, features, num_points, statistics: None };
    let (out, state) = apply(kernel, [input(weight), input(gamma), input(beta)])?;
    let state = state.expect("training has a state");
    Some((out, state.statistics.clone(), state.count))
}

/// The same with running statistics, for tensors without autodiff graph.
pub fn pillar_net_inference(
    (features, num_points): Points,
    (weight, gamma, beta): (&Tensor<2>, &Tensor<1>, &Tensor<1>),
    max_points: usize,
    epsilon: f64,
    statistics: impl FnOnce() -> Statistics,
) -> Option<Tensor<2>> {
    let net = net(weight, max_points, epsilon)?;
    let Input::Plain(_) = input(weight)? else { return None };
    let kernel = PillarKernel { net, features, num_points, statistics: Some(statistics()) };
    apply(kernel, [input(weight), input(gamma), input(beta)]).map(|(out, _)| out)
}

fn net(weight: &Tensor<2>, max_points: usize, epsilon: f64) -> Option<PillarNet> {
    let [outputs, inputs] = weight.dims();
    (inputs <= kernels::pillar_net::MOST_INPUTS).then_some(PillarNet { inputs, outputs, max_points, epsilon })
}
