//! Shared MLP (PointNet++'s set abstraction, feature propagation and heads): layers of linear without bias, batch norm and ReLU on rows, and
//! the maximum over groups of rows.
//!
//! Blocks of rows are worked on while they are in the cache. In training the rows of a layer before its batch norm are kept, but for a first
//! layer that is gathered and for the last before a maximum.

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
    /// Channels of the rows, C0, and behind each layer. C0 is 0 for [`MlpInput::Projected`] and 3 for [`MlpInput::Gathered`].
    pub channels: Vec<usize>,
    /// Added to the variances.
    pub epsilon: f64,
}

/// What the first layer reads.
#[derive(Clone, Copy, Debug)]
pub enum MlpInput<'a> {
    /// Rows, `[N, C0]`.
    Rows(&'a [f32]),
    /// What the first layer's linear part makes of them, `[N, C1]`.
    Projected(&'a [f32]),
    /// Rows of neighbours: the linear part of features, computed once for each point, and offsets, on which the layer's weights `[C1, 3]` work.
    Gathered {
        /// The linear part of the features of each point, `[P, C1]`.
        features: &'a [f32],
        /// The point of each row, `[N]`.
        source: &'a [u32],
        /// Offset of each row from the centre of its group, `[N]`.
        offset: &'a [[f32; 3]],
    },
}

/// How rows belong together, and how often each counts.
#[derive(Clone, Copy, Debug, Default)]
pub struct RowGroups<'a> {
    /// Where each group ends, the first beginning at 0; none may be empty. Without, there is no maximum: each row is an output.
    pub ends: Option<&'a [u32]>,
    /// How often each row counts in the statistics, `[N]`; once if not given. A row that counts twice is as good as two equal rows of its group.
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
    /// Mean and variance of each layer; zero where there are no rows.
    pub statistics: Vec<Statistics>,
    /// Rows, as often as they count.
    pub count: f64,
    /// The rows of each layer before the batch norm; empty where they are not kept.
    hidden: Vec<Vec<f32>>,
    extremes: Option<Extremes>,
}

/// Gradients by the parameters of a layer.
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
    /// Normalises by the statistics of the rows. `out`, `[groups, outputs]`, is overwritten, whatever it held.
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

    /// Gradients by the parameters of each layer, and by the input, if `dx` is given: it is overwritten, whatever it held.
    ///
    /// # Shapes
    /// `dout`: `[groups, outputs]`; `dx`: as the rows, their projections, or the features that are gathered.
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

    /// Normalises by given statistics. `out`, `[groups, outputs]`, is overwritten, whatever it held.
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

    /// Whether a maximum follows a layer and its rows need not be kept.
    fn pools(&self, groups: RowGroups<'_>, layer: usize) -> bool {
        groups.ends.is_some() && layer + 2 == self.channels.len()
    }

    /// What a layer reads, or what comes out behind the last.
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
        assert!(!layers.is_empty() && layers.len() + 1 == self.channels.len(), "a layer for each width of {self:?}");
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
        assert!(!only_gathered, "a layer with a product before the maximum: {self:?}");
        for (layer, widths) in layers.iter().zip(self.channels.windows(2)) {
            assert!(widths[1] > 0, "channels of {self:?}");
            assert_eq!(layer.weight.len(), widths[0] * widths[1], "weights of {self:?}");
            assert_eq!((layer.gamma.len(), layer.beta.len()), (widths[1], widths[1]), "norm of {self:?}");
        }
        Blocks::new(self.rows, groups)
    }
}

/// The gradient by the weights of a first layer without a product, and by its input.
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
