//! Shared MLP (PointNet++'s set abstraction, feature propagation and heads): layers of linear without bias, batch norm
//! and ReLU on rows, followed by the maximum over groups of rows.
//!
//! Rows are processed in blocks that fit the cache. Training stores the rows of each layer before its batch norm,
//! except those of a gathered first layer and those of the last layer before a maximum.

mod blocks;
mod dense;
mod inference;
mod input;
mod norm;
mod pooling;
mod scatter;

use crate::batch_norm::Statistics;
use crate::output::{Shared, fill};
use crate::scratch;
use blocks::Blocks;
use dense::{Layer, Upstream};
use input::{Before, Input};
use norm::{Norm, NormGradient};
use pooling::{Extremes, Pooled};

/// The shape of a net.
#[derive(Clone, Debug, PartialEq)]
pub struct SharedMlp {
    /// Rows, N.
    pub rows: usize,
    /// Channels of the input rows, C0, and of the output of each layer. C0 is 0 for [`MlpInput::Projected`] and 3 for
    /// [`MlpInput::Gathered`].
    pub channels: Vec<usize>,
    /// Added to the variances.
    pub epsilon: f64,
}

/// The input of the first layer.
#[derive(Clone, Copy, Debug)]
pub enum MlpInput<'a> {
    /// Rows, `[N, C0]`.
    Rows(&'a [f32]),
    /// The output of the first layer's linear part, `[N, C1]`.
    Projected(&'a [f32]),
    /// Rows of neighbours: the linear part of the features is computed once per point, and the layer's weights `[C1,
    /// 3]` apply to the offsets.
    Gathered {
        /// The linear part of the features of each point, `[P, C1]`.
        features: &'a [f32],
        /// The point of each row, `[N]`.
        source: &'a [u32],
        /// Offset of each row from the centre of its group, `[N]`.
        offset: &'a [[f32; 3]],
    },
}

/// Grouping and multiplicity of the rows.
#[derive(Clone, Copy, Debug, Default)]
pub struct RowGroups<'a> {
    /// End of each group; the first begins at 0, and none may be empty. Without groups there is no maximum and each row
    /// is an output.
    pub ends: Option<&'a [u32]>,
    /// Multiplicity of each row, `[N]`; 1 if not given. A row with multiplicity 2 equals two equal rows of its group.
    pub counts: Option<&'a [f32]>,
}

/// Learned parameters of a layer.
#[derive(Clone, Copy, Debug)]
pub struct MlpLayer<'a> {
    /// `[outputs, inputs]`.
    pub weight: &'a [f32],
    /// Scale of the batch norm, `[outputs]`.
    pub gamma: &'a [f32],
    /// Shift of the batch norm, `[outputs]`.
    pub beta: &'a [f32],
}

/// What the backward pass needs of the forward pass.
#[derive(Clone, Debug)]
pub struct MlpState {
    /// Mean and variance of each layer; zero without rows.
    pub statistics: Vec<Statistics>,
    /// Sum of the multiplicities of the rows.
    pub count: f64,
    /// The rows of each layer before the batch norm; empty if they are not stored.
    hidden: Vec<Vec<f32>>,
    extremes: Option<Extremes>,
}

/// Gradients with respect to the parameters of a layer.
#[derive(Clone, Debug, PartialEq)]
pub struct MlpGradients {
    /// `[outputs, inputs]`.
    pub weight: Vec<f32>,
    /// `[outputs]`.
    pub gamma: Vec<f32>,
    /// `[outputs]`.
    pub beta: Vec<f32>,
}

impl SharedMlp {
    /// Forward pass with the statistics of the rows. `out`, `[groups, outputs]`, is overwritten.
    pub fn forward_train(
        &self,
        input: MlpInput<'_>,
        groups: RowGroups<'_>,
        layers: &[MlpLayer<'_>],
        out: &mut Vec<f32>,
    ) -> MlpState {
        let blocks = self.check(input, groups, layers);
        let mut state = MlpState { statistics: vec![], count: blocks.total, hidden: vec![], extremes: None };
        let mut norms: Vec<Norm> = Vec::new();
        for (l, layer) in layers.iter().enumerate() {
            let mut y = Vec::new();
            let statistics = match (l, Before::first(input, layer.weight)) {
                (0, Some(before)) => dense::statistics(&blocks, before, layer.gamma.len()),
                _ => {
                    let input = self.input(input, layers, &state.hidden, &norms, l);
                    if self.pools(groups, l) {
                        let (statistics, extremes) = pooling::forward(&blocks, input, layer.weight, layer.gamma);
                        state.extremes = Some(extremes);
                        statistics
                    } else {
                        dense::forward(&blocks, input, layer.weight, &mut y)
                    }
                }
            };
            norms.push(Norm::new(&statistics, layer.gamma, layer.beta, self.epsilon));
            state.statistics.push(statistics);
            state.hidden.push(y);
        }
        match &state.extremes {
            Some(extremes) => pooling::output(extremes, &norms[layers.len() - 1], out),
            None => write_rows(&blocks, self.input(input, layers, &state.hidden, &norms, layers.len()), out),
        }
        state
    }

    /// Gradients with respect to the parameters of each layer, and with respect to the input if `dx` is given, which is
    /// overwritten.
    ///
    /// # Shapes
    /// `dout`: `[groups, outputs]`; `dx`: the shape of the rows, of their projections, or of the gathered features.
    pub fn backward(
        &self,
        input: MlpInput<'_>,
        groups: RowGroups<'_>,
        layers: &[MlpLayer<'_>],
        state: &MlpState,
        dout: &[f32],
        mut dx: Option<&mut Vec<f32>>,
    ) -> Vec<MlpGradients> {
        let blocks = self.check(input, groups, layers);
        let last = layers.len() - 1;
        assert_eq!(dout.len(), blocks.groups() * self.channels[last + 1], "elements of dout of {self:?}");
        let norm =
            |(layer, statistics): (&MlpLayer<'_>, _)| Norm::new(statistics, layer.gamma, layer.beta, self.epsilon);
        let norms: Vec<Norm> = layers.iter().zip(&state.statistics).map(norm).collect();
        let before = |l: usize| match (l, Before::first(input, layers[0].weight)) {
            (0, Some(before)) => before,
            _ => Before::Stored(&state.hidden[l]),
        };
        let mut upstream = match &state.extremes {
            Some(extremes) => pooling::last(extremes, &norms[last], dout),
            None => dense::last(&blocks, before(last), &norms[last], dout),
        };
        let mut gradients = Vec::new();
        for (l, layer) in layers.iter().enumerate().rev() {
            let (weight, statistics, norm) = (layer.weight, &state.statistics[l], &norms[l]);
            let gradient = NormGradient::new(&upstream.sums, blocks.total, statistics, layer.gamma, self.epsilon);
            let dense = Layer { weight, before: before(l), norm, gradient: &gradient };
            let weight = if l == 0 && Before::first(input, weight).is_some() {
                backward_first(&blocks, input, dense, &upstream, dx.as_deref_mut())
            } else {
                let input = self.input(input, layers, &state.hidden, &norms, l);
                let wanted = l > 0 || dx.is_some();
                let (weight, before) = match &state.extremes {
                    Some(extremes) if l == last => {
                        let pooled = Pooled { weight, statistics, norm, gradient: &gradient, extremes };
                        pooling::backward(&blocks, input, pooled, &upstream, wanted)
                    }
                    _ => dense::backward(&blocks, input, dense, &upstream, wanted),
                };
                upstream = before;
                if let (0, Some(dx)) = (l, &mut dx) {
                    **dx = std::mem::take(&mut upstream.gradient);
                }
                weight
            };
            gradients.push(MlpGradients { weight, gamma: gradient.gamma, beta: gradient.beta });
        }
        gradients.reverse();
        gradients
    }

    /// Forward pass with given statistics. `out`, `[groups, outputs]`, is overwritten.
    pub fn forward(
        &self,
        input: MlpInput<'_>,
        groups: RowGroups<'_>,
        layers: &[MlpLayer<'_>],
        statistics: &[Statistics],
        out: &mut Vec<f32>,
    ) {
        let blocks = self.check(input, groups, layers);
        inference::forward(self, &blocks, input, layers, statistics, out);
    }

    /// Whether a maximum follows a layer, so that its rows are not stored.
    fn pools(&self, groups: RowGroups<'_>, layer: usize) -> bool {
        groups.ends.is_some() && layer + 2 == self.channels.len()
    }

    /// The input of a layer, or the output of the last one.
    fn input<'a>(
        &self,
        input: MlpInput<'a>,
        layers: &[MlpLayer<'a>],
        hidden: &'a [Vec<f32>],
        norms: &'a [Norm],
        layer: usize,
    ) -> Input<'a> {
        match (layer, input) {
            (0, MlpInput::Rows(x)) => Input::Given { x, channels: self.channels[0] },
            _ => {
                let before = match (layer, Before::first(input, layers[0].weight)) {
                    (1, Some(before)) => before,
                    _ => Before::Stored(&hidden[layer - 1]),
                };
                Input::Hidden { before, norm: &norms[layer - 1] }
            }
        }
    }

    fn check<'a>(&self, input: MlpInput<'_>, groups: RowGroups<'a>, layers: &[MlpLayer<'_>]) -> Blocks<'a> {
        assert!(!layers.is_empty() && layers.len() + 1 == self.channels.len(), "number of layers of {self:?}");
        let [first, second] = [self.channels[0], self.channels[1]];
        match input {
            MlpInput::Rows(x) => assert!(first > 0 && x.len() == self.rows * first, "elements of x of {self:?}"),
            MlpInput::Projected(y) => assert!(first == 0 && y.len() == self.rows * second, "elements of y of {self:?}"),
            MlpInput::Gathered { features, source, offset } => {
                assert!(first == 3 && features.len() % second == 0, "features of {self:?}");
                assert_eq!((source.len(), offset.len()), (self.rows, self.rows), "sources and offsets of {self:?}");
            }
        }
        let only_gathered = groups.ends.is_some() && layers.len() == 1 && !matches!(input, MlpInput::Rows(_));
        assert!(!only_gathered, "a gathered input needs a second layer before the maximum: {self:?}");
        for (layer, widths) in layers.iter().zip(self.channels.windows(2)) {
            assert!(widths[1] > 0, "channels of {self:?}");
            assert_eq!(layer.weight.len(), widths[0] * widths[1], "weights of {self:?}");
            assert_eq!((layer.gamma.len(), layer.beta.len()), (widths[1], widths[1]), "norm of {self:?}");
        }
        Blocks::new(self.rows, groups)
    }
}

/// The gradient with respect to the weights of a first layer without a matrix product, and with respect to its input.
fn backward_first(
    blocks: &Blocks<'_>,
    input: MlpInput<'_>,
    layer: Layer<'_>,
    upstream: &Upstream,
    dx: Option<&mut Vec<f32>>,
) -> Vec<f32> {
    let offset = match input {
        MlpInput::Gathered { offset, .. } => Some(offset),
        _ => None,
    };
    let (rows, weight) = dense::backward_first(blocks, layer, offset, upstream);
    match (input, dx) {
        (MlpInput::Gathered { features, source, .. }, Some(dx)) => {
            let channels = layer.norm.channels();
            scatter::add_up(&rows, source, features.len() / channels, channels, dx);
        }
        (_, Some(dx)) => *dx = rows,
        _ => {}
    }
    weight
}

/// `relu(norm(y))` of all rows.
fn write_rows(blocks: &Blocks<'_>, input: Input<'_>, out: &mut Vec<f32>) {
    let channels = input.channels();
    // SAFETY: the blocks cover all rows.
    unsafe {
        fill(out, blocks.rows * channels, |out| {
            let out = Shared::new(out);
            blocks.parts(|part| {
                scratch::with([blocks.most_rows * channels; 2], |[memory, before]| {
                    for block in part {
                        // SAFETY: no row is in two blocks.
                        out.write(block.rows.start * channels, input.rows(block, memory, before).0);
                    }
                });
            });
        });
    }
}

#[cfg(test)]
mod tests;
