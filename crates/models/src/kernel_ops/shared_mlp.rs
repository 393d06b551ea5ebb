//! Layers over rows and the maximum over groups of neighbours as one operation.

use super::{Input, Kernel, apply, input};
use crate::point_ops::Groups;
use burn::tensor::Tensor;
use kernels::{MlpInput, MlpLayer, MlpState, RowGroups, SharedMlp, Statistics};
use std::sync::Arc;

/// The input of the first layer.
#[derive(Clone, Debug)]
pub enum MlpRows {
    /// Rows, `[N, C0]`.
    Rows(Tensor<2>),
    /// The output of the first layer's linear part, `[N, C1]`.
    Projected(Tensor<2>),
    /// The linear part of the features of each point, `[P, C1]`; the groups define which rows gather it.
    Gathered(Tensor<2>),
}

impl MlpRows {
    fn tensor(&self) -> &Tensor<2> {
        match self {
            MlpRows::Rows(x) | MlpRows::Projected(x) | MlpRows::Gathered(x) => x,
        }
    }
}

/// Groups of the rows, and what they are for.
#[derive(Clone, Copy, Debug)]
pub enum MlpGroups<'a> {
    /// Each row counts once and is an output.
    None,
    /// Rows have the multiplicities of the groups, and each is an output.
    Counted(&'a Arc<Groups>),
    /// The same, and the maximum over each group is an output.
    Maximum(&'a Arc<Groups>),
}

impl<'a> From<Option<&'a Arc<Groups>>> for MlpGroups<'a> {
    fn from(groups: Option<&'a Arc<Groups>>) -> Self {
        groups.map_or(MlpGroups::None, MlpGroups::Maximum)
    }
}

impl<'a> MlpGroups<'a> {
    fn groups(self) -> Option<&'a Arc<Groups>> {
        match self {
            MlpGroups::None => None,
            MlpGroups::Counted(groups) | MlpGroups::Maximum(groups) => Some(groups),
        }
    }
}

/// Learned parameters of a layer.
#[derive(Clone, Debug)]
pub struct MlpParameters {
    /// `[C_out, C_in]`; for a gathered first layer only the columns of the offsets, `[C_out, 3]`.
    pub weight: Tensor<2>,
    /// `[C_out]`.
    pub gamma: Tensor<1>,
    /// `[C_out]`.
    pub beta: Tensor<1>,
}

/// The kind of the first layer's input.
#[derive(Clone, Copy, Debug)]
enum Form {
    Rows,
    Projected,
    Gathered,
}

#[derive(Clone, Debug)]
struct MlpKernel {
    mlp: SharedMlp,
    form: Form,
    groups: Option<Arc<Groups>>,
    /// Whether the maximum over each group is the output.
    maximum: bool,
    /// Running statistics, for inference.
    statistics: Option<Vec<Statistics>>,
}

impl MlpKernel {
    fn input<'a>(&'a self, x: &'a [f32]) -> MlpInput<'a> {
        match (self.form, &self.groups) {
            (Form::Gathered, Some(groups)) => {
                MlpInput::Gathered { features: x, source: &groups.source, offset: &groups.offset_m }
            }
            (Form::Projected, _) => MlpInput::Projected(x),
            _ => MlpInput::Rows(x),
        }
    }

    fn groups(&self) -> RowGroups<'_> {
        self.groups.as_deref().map_or_else(RowGroups::default, |groups| RowGroups {
            ends: self.maximum.then_some(&groups.ends[..]),
            counts: Some(&groups.count),
        })
    }

    /// Indices of the inputs after the rows; a projected first layer has no weight.
    fn layers<'a>(&self, parameters: &[&'a [f32]]) -> Vec<MlpLayer<'a>> {
        let (projected, layers) = parameters.split_at(parameters.len() % 3);
        let first = projected.first().zip(projected.get(1)).map(|(gamma, beta)| MlpLayer { weight: &[], gamma, beta });
        let rest = layers.as_chunks::<3>().0.iter().map(|&[weight, gamma, beta]| MlpLayer { weight, gamma, beta });
        first.into_iter().chain(rest).collect()
    }
}

/// Rows, then weight, gamma and beta of each layer.
impl<const N: usize> Kernel<N> for MlpKernel {
    /// `None` at inference.
    type State = Option<Arc<MlpState>>;

    fn forward(&self, inputs: [&[f32]; N]) -> (Vec<f32>, Self::State) {
        let (x, layers) = (self.input(inputs[0]), self.layers(&inputs[1..]));
        let mut out = Vec::new();
        let state = match &self.statistics {
            None => Some(Arc::new(self.mlp.forward_train(x, self.groups(), &layers, &mut out))),
            Some(statistics) => {
                self.mlp.forward(x, self.groups(), &layers, statistics, &mut out);
                None
            }
        };
        (out, state)
    }

    fn backward(
        &self,
        inputs: [&[f32]; N],
        state: &Self::State,
        dy: &[f32],
        wanted: [bool; N],
    ) -> [Option<Vec<f32>>; N] {
        let state = state.as_ref().expect("only training has a backward pass");
        let (x, layers) = (self.input(inputs[0]), self.layers(&inputs[1..]));
        let mut dx = Vec::new();
        let dx_wanted = wanted[0].then_some(&mut dx);
        let gradients = self.mlp.backward(x, self.groups(), &layers, state, dy, dx_wanted);
        let parameters = gradients.into_iter().flat_map(|g| [g.weight, g.gamma, g.beta]);
        let projected = matches!(self.form, Form::Projected);
        let mut all = std::iter::once(dx).chain(parameters.skip(usize::from(projected)));
        std::array::from_fn(|i| all.next().filter(|_| wanted[i]))
    }

    fn shape(&self) -> Vec<usize> {
        let groups = self.groups.as_ref().filter(|_| self.maximum);
        let outputs = groups.map_or(self.mlp.rows, |groups| groups.ends.len());
        vec![outputs, self.mlp.channels[self.mlp.channels.len() - 1]]
    }
}

/// Layers of linear, batch norm and ReLU, followed by the maximum over groups if wanted. Also returns the statistics of
/// each layer and the number of rows.
///
/// # Shapes
/// `rows`: see [`MlpRows`]; result `[G, C]`, or `[N, C]` without a maximum.
pub fn shared_mlp(
    rows: &MlpRows,
    groups: MlpGroups<'_>,
    layers: &[MlpParameters],
    epsilon: f64,
) -> Option<(Tensor<2>, Vec<Statistics>, usize)> {
    let (out, state) = run(kernel(rows, groups, layers, epsilon, None)?, rows, layers)?;
    let state = state.expect("training has a state");
    Some((out, state.statistics.clone(), state.count as usize))
}

/// The same with running statistics, for tensors without autodiff graph.
pub fn shared_mlp_inference(
    rows: &MlpRows,
    groups: MlpGroups<'_>,
    layers: &[MlpParameters],
    epsilon: f64,
    statistics: impl FnOnce() -> Vec<Statistics>,
) -> Option<Tensor<2>> {
    let Input::Plain(_) = input(rows.tensor())? else { return None };
    run(kernel(rows, groups, layers, epsilon, Some(statistics()))?, rows, layers).map(|(out, _)| out)
}

fn kernel(
    rows: &MlpRows,
    groups: MlpGroups<'_>,
    layers: &[MlpParameters],
    epsilon: f64,
    statistics: Option<Vec<Statistics>>,
) -> Option<MlpKernel> {
    let (maximum, groups) = (matches!(groups, MlpGroups::Maximum(_)), groups.groups());
    let [n, channels] = rows.tensor().dims();
    let (form, rows, first) = match rows {
        MlpRows::Rows(_) => (Form::Rows, n, channels),
        MlpRows::Projected(_) if groups.is_some() => return None,
        MlpRows::Projected(_) => (Form::Projected, n, 0),
        MlpRows::Gathered(_) if layers.len() == 1 => return None,
        MlpRows::Gathered(_) => (Form::Gathered, groups?.source.len(), 3),
    };
    let channels = std::iter::once(first).chain(layers.iter().map(|layer| layer.gamma.dims()[0])).collect();
    Some(MlpKernel { mlp: SharedMlp { rows, channels, epsilon }, form, groups: groups.cloned(), maximum, statistics })
}

type Ran = (Tensor<2>, Option<Arc<MlpState>>);

fn run(kernel: MlpKernel, rows: &MlpRows, layers: &[MlpParameters]) -> Option<Ran> {
    let parameters = layers.iter().flat_map(|l| [input(&l.weight), input(&l.gamma), input(&l.beta)]);
    let projected = usize::from(matches!(kernel.form, Form::Projected));
    let inputs: Vec<_> = std::iter::once(input(rows.tensor())).chain(parameters.skip(projected)).collect();
    match inputs.len() {
        3 => run_with::<3>(kernel, inputs),
        4 => run_with::<4>(kernel, inputs),
        6 => run_with::<6>(kernel, inputs),
        7 => run_with::<7>(kernel, inputs),
        9 => run_with::<9>(kernel, inputs),
        10 => run_with::<10>(kernel, inputs),
        _ => None,
    }
}

fn run_with<const N: usize>(kernel: MlpKernel, inputs: Vec<Option<Input>>) -> Option<Ran> {
    apply(kernel, <[Option<Input>; N]>::try_from(inputs).ok()?)
}
