//! The shared MLP by the kernels.

use super::operation::{Argument, Operation, run};
use super::{algorithm, moments};
use crate::layers::Moments;
use burn::tensor::Tensor;
use kernels::{MlpInput, MlpLayer, MlpState, RowGroups, SharedMlp};
use std::sync::Arc;

/// Where rows come from and how they belong together, as the kernel wants it.
#[derive(Clone, Debug, Default)]
pub struct MlpRows {
    /// Number of rows, N.
    pub rows: usize,
    /// Where each group ends; without, there is no maximum.
    pub ends: Option<Arc<[u32]>>,
    /// How often each row counts, N; once if not given.
    pub counts: Option<Arc<[f32]>>,
    /// The point of each row and its offset from the centre of its group, m, where features of points are gathered.
    pub gathered: Option<(Arc<[u32]>, Arc<[[f32; 3]]>)>,
}

/// Parameters of a layer.
#[derive(Clone, Debug)]
pub struct MlpTensors {
    /// `[outputs, inputs]`, for a gathered first layer `[outputs, 3]`.
    pub weight: Tensor<2>,
    /// `[outputs]`.
    pub gamma: Tensor<1>,
    /// `[outputs]`.
    pub beta: Tensor<1>,
}

/// Two or three layers of linear, batch norm and ReLU, and the maximum over groups; with the statistics of each layer for the running ones.
///
/// # Shapes
/// `x`: the linear part of the features of each point, `[P, C1]`, where they are gathered, else rows `[N, C0]`; result `[G, C]`. `None` where
/// there is no kernel.
pub fn shared_mlp(x: &Tensor<2>, rows: &MlpRows, layers: &[MlpTensors], epsilon: f64) -> Option<(Tensor<2>, Vec<Moments>)> {
    algorithm()?;
    let first = if rows.gathered.is_some() { 3 } else { x.dims()[1] };
    let channels = std::iter::once(first).chain(layers.iter().map(|l| l.gamma.dims()[0])).collect();
    let operation = OnRows { mlp: SharedMlp { rows: rows.rows, channels, epsilon }, rows: rows.clone() };
    let of = |l: &MlpTensors| Some([Argument::of(&l.weight)?, Argument::of(&l.gamma)?, Argument::of(&l.beta)?]);
    let x = Argument::of(x)?;
    let (y, state) = match layers {
        [a] => {
            let [a0, a1, a2] = of(a)?;
            run::<_, 4, 2>(operation, [x, a0, a1, a2])?
        }
        [a, b] => {
            let ([a0, a1, a2], [b0, b1, b2]) = (of(a)?, of(b)?);
            run::<_, 7, 2>(operation, [x, a0, a1, a2, b0, b1, b2])?
        }
        [a, b, c] => {
            let ([a0, a1, a2], [b0, b1, b2], [c0, c1, c2]) = (of(a)?, of(b)?, of(c)?);
            run::<_, 10, 2>(operation, [x, a0, a1, a2, b0, b1, b2, c0, c1, c2])?
        }
        _ => return None,
    };
    let device = y.device();
    let moments = state.statistics.iter().map(|s| moments(s, state.count as usize, &device)).collect();
    Some((y, moments))
}

#[derive(Clone, Debug)]
struct OnRows {
    mlp: SharedMlp,
    rows: MlpRows,
}

impl OnRows {
    fn input<'a>(&'a self, x: &'a [f32]) -> MlpInput<'a> {
        match &self.rows.gathered {
            Some((source, offset)) => MlpInput::Gathered { features: x, source, offset },
            None => MlpInput::Rows(x),
        }
    }

    fn groups(&self) -> RowGroups<'_> {
        RowGroups { ends: self.rows.ends.as_deref(), counts: self.rows.counts.as_deref() }
    }
}

fn layers<'a>(parameters: &[&'a [f32]]) -> Vec<MlpLayer<'a>> {
    parameters.chunks_exact(3).map(|p| MlpLayer { weight: p[0], gamma: p[1], beta: p[2] }).collect()
}

/// The rows, then weight, gamma and beta of each layer.
impl<const N: usize> Operation<N> for OnRows {
    type State = MlpState;

    fn forward(&self, inputs: [&[f32]; N]) -> (Vec<f32>, Vec<usize>, MlpState) {
        let mut out = Vec::new();
        let state = self.mlp.forward_train(self.input(inputs[0]), self.groups(), &layers(&inputs[1..]), &mut out);
        let groups = self.rows.ends.as_ref().map_or(self.mlp.rows, |ends| ends.len());
        let outputs = self.mlp.channels[self.mlp.channels.len() - 1];
        (out, vec![groups, outputs], state)
    }

    fn backward(
        &self,
        inputs: [&[f32]; N],
        state: &MlpState,
        gradient: &[f32],
        wanted: [bool; N],
    ) -> [Option<Vec<f32>>; N] {
        let mut dx = Vec::new();
        let dx_wanted = if wanted[0] { Some(&mut dx) } else { None };
        let layers = layers(&inputs[1..]);
        let gradients =
            self.mlp.backward(self.input(inputs[0]), self.groups(), &layers, state, gradient, dx_wanted);
        let parameters = gradients.into_iter().flat_map(|g| [g.weight, g.gamma, g.beta]);
        let mut all = std::iter::once(dx).chain(parameters);
        std::array::from_fn(|i| all.next().filter(|_| wanted[i]))
    }
}
