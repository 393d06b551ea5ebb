//! t-SNE (van der Maaten and Hinton 2008; Barnes-Hut 2014; interpolated, Linderman et al. 2019), through the crate
//! `bhtsne`.

use super::{FeatureError, Features};
use bhtsne::Neighbor;
use data::stream;
use nalgebra::SymmetricEigen;
use rand::RngExt;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Schema version of [`Embedding`] as JSON.
pub const TSNE_SCHEMA: &str = "lidarshift.tsne/1";

/// How repulsive forces are computed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", tag = "kind", deny_unknown_fields)]
pub enum TsneMethod {
    /// All pairs.
    Exact,
    /// Barnes-Hut tree; a smaller `theta` is more exact, 0.5 is common.
    BarnesHut {
        /// Greater than 0.
        theta: f64,
    },
    /// By interpolation on a grid.
    Interpolated,
}

/// Settings of t-SNE.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TsneOptions {
    /// Effective number of neighbours per point.
    pub perplexity: f64,
    /// Number of gradient descent steps.
    pub steps: usize,
    /// Seed of the small perturbation of the PCA initialisation.
    pub seed: u64,
    /// How repulsive forces are computed.
    pub method: TsneMethod,
}

impl Default for TsneOptions {
    fn default() -> Self {
        TsneOptions { perplexity: 30.0, steps: 1000, seed: 0, method: TsneMethod::BarnesHut { theta: 0.5 } }
    }
}

/// An embedded sample.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Embedded {
    /// What the network was trained on.
    pub train_set: String,
    /// The seed of the run.
    pub seed: u64,
    /// The test frame.
    pub frame: String,
    /// Position in the embedding, without unit.
    pub at: [f64; 2],
}

/// A 2D embedding of features, for the report.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Embedding {
    /// [`TSNE_SCHEMA`].
    pub schema: String,
    /// The network.
    pub network: String,
    /// The layer, and how its values are pooled into one vector per cloud.
    pub layer: String,
    /// The test set.
    pub test_set: String,
    /// Settings used.
    pub options: TsneOptions,
    /// Final Kullback-Leibler divergence.
    pub kl_divergence: f64,
    /// All points.
    pub points: Vec<Embedded>,
}

/// Embeds the samples in the plane and returns the positions and the final KL divergence. Neighbourhoods are
/// preserved; distances between clusters and cluster sizes are not meaningful.
///
/// Initialised with the first two principal components. The first 250 steps use early exaggeration of 12 and a
/// learning rate of n / 12 (Belkina et al. 2019), the remaining steps a rate of 3 n. The library clips its gains at 2
/// and omits the gradient's factor of 4, and needs that rate to converge as other implementations do.
///
/// The result does not depend on the number of threads: the neighbour search is parallel, but the library's gradient
/// descent runs on one thread, since its parallel sums have no fixed order.
///
/// # Errors
/// Fewer samples than three times the perplexity, or invalid settings.
pub fn tsne(features: &Features, options: &TsneOptions) -> Result<(Vec<[f64; 2]>, f64), FeatureError> {
    let wrong = |message: String| Err(FeatureError::Setting(message));
    if !(options.perplexity >= 1.0 && options.perplexity.is_finite()) {
        return wrong(format!("perplexity is {}, it has to be 1 or more", options.perplexity));
    }
    if let TsneMethod::BarnesHut { theta } = options.method
        && !(theta > 0.0 && theta <= 2.0)
    {
        return wrong(format!("theta is {theta}, it has to lie between 0 and 2; `exact` is the method for 0"));
    }
    let n = features.len();
    let n_neighbors = (3.0 * options.perplexity) as usize;
    if n < n_neighbors + 2 {
        return Err(FeatureError::TooFew { what: "t-SNE with this perplexity", least: n_neighbors + 2, n });
    }
    let rows: Vec<&[f32]> = features.rows().collect();
    let neighbors = nearest_rows(features, n_neighbors);
    let exaggerated = options.steps.min(EXAGGERATED_STEPS);
    let phases = [
        (exaggerated, EXAGGERATION, (n as f32 / EXAGGERATION).max(LEAST_RATE), 0.5),
        (options.steps - exaggerated, 1.0, (LATE_RATE * n as f32).max(LEAST_RATE), 0.8),
    ];
    let descend = |places: Vec<f32>, (steps, exaggeration, rate, momentum): (usize, f32, f32, f32)| {
        let mut fit = bhtsne::tSNE::<f32, &[f32], 2>::new(&rows);
        fit.perplexity(options.perplexity as f32).epochs(steps).initial_embedding(places);
        fit.early_exaggeration(exaggeration).stop_lying_epoch(steps + 1);
        fit.learning_rate(rate).momentum(momentum).final_momentum(momentum);
        match options.method {
            TsneMethod::Exact => fit.barnes_hut_with_neighbors(NO_CELL_IS_FAR, &neighbors),
            TsneMethod::BarnesHut { theta } => fit.barnes_hut_with_neighbors(theta as f32, &neighbors),
            TsneMethod::Interpolated => fit.fit_sne_with_neighbors(&neighbors),
        };
        fit.embedding()
    };
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build();
    let one = one.map_err(|e| FeatureError::Setting(format!("no thread could be started: {e}")))?;
    let places = one.install(|| phases.into_iter().fold(initial_positions(features, options.seed), descend));
    if let Some(i) = places.iter().position(|v| !v.is_finite()) {
        return wrong(format!("the descent left the numbers at sample {}; try another perplexity", i / 2));
    }
    let places: Vec<[f64; 2]> = places.chunks_exact(2).map(|p| [f64::from(p[0]), f64::from(p[1])]).collect();
    let divergence = divergence(&neighbors, options.perplexity, &places);
    Ok((places, divergence))
}

/// Steps with early exaggeration, and its factor (van der Maaten and Hinton 2008; Belkina et al. 2019).
const EXAGGERATED_STEPS: usize = 250;
const EXAGGERATION: f32 = 12.0;

/// Learning rate per sample after early exaggeration. Between 2 and 4 the divergence hardly changes (tested on 10,000
/// x 128 and 400 x 128); with 1 it is larger.
const LATE_RATE: f32 = 3.0;

/// Minimum learning rate, used for few samples.
const LEAST_RATE: f32 = 50.0;

/// A theta at which the tree treats every point individually.
const NO_CELL_IS_FAR: f32 = 1e-6;

/// KL divergence between the affinities of the embedding and those of the nearest neighbours, over all pairs.
fn divergence(neighbors: &[Vec<Neighbor<f32>>], perplexity: f64, places: &[[f64; 2]]) -> f64 {
    let closeness = |a: &[f64; 2], b: &[f64; 2]| 1.0 / (1.0 + (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2));
    let of_row = |a: &[f64; 2]| places.iter().map(|b| closeness(a, b)).sum::<f64>() - 1.0;
    let total: f64 = places.par_iter().map(of_row).collect::<Vec<_>>().iter().sum();
    let weights: Vec<Vec<(usize, f64)>> = neighbors.par_iter().map(|row| weights(row, perplexity)).collect();
    let of_row = |i: usize| {
        let pair = |&(j, forth): &(usize, f64)| {
            let back = weights[j].iter().find(|(k, _)| *k == i).map(|(_, back)| *back);
            let p = (forth + back.unwrap_or(0.0)) / (2.0 * places.len() as f64);
            // Mutual neighbours are found again in the other row.
            let orders = if back.is_some() { 1.0 } else { 2.0 };
            if p > 0.0 { orders * p * (p * total / closeness(&places[i], &places[j])).ln() } else { 0.0 }
        };
        weights[i].iter().map(pair).sum::<f64>()
    };
    (0..places.len()).into_par_iter().map(of_row).collect::<Vec<_>>().iter().sum()
}

/// Index and conditional probability of every neighbour of a sample; the distribution has the given perplexity.
fn weights(row: &[Neighbor<f32>], perplexity: f64) -> Vec<(usize, f64)> {
    let squared: Vec<f64> = row.iter().map(|n| f64::from(n.distance).powi(2)).collect();
    let mean = squared.iter().sum::<f64>() / squared.len() as f64;
    let shares = |beta: f64| -> Vec<f64> {
        let raw: Vec<f64> = squared.iter().map(|s| (-beta * s).exp()).collect();
        let sum: f64 = raw.iter().sum();
        raw.iter().map(|r| r / sum).collect()
    };
    let entropy = |p: &[f64]| -> f64 { p.iter().filter(|p| **p > 0.0).map(|p| -p * p.ln()).sum() };
    // Binary search over log(beta): the entropy falls as beta grows.
    let scale = if mean > 0.0 { mean.ln() } else { 0.0 };
    let [mut low, mut high] = [-30.0 - scale, 30.0 - scale];
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        *(if entropy(&shares(middle.exp())) > perplexity.ln() { &mut low } else { &mut high }) = middle;
    }
    row.iter().map(|n| n.index).zip(shares((0.5 * (low + high)).exp())).collect()
}

fn squared(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
}

/// The nearest rows of every row, excluding itself, by ascending distance; ties keep the row order.
///
/// The squared distance of the nearest neighbour is subtracted from all squared distances. Affinities depend on
/// differences of squared distances only, and the library's single-precision `exp(-beta d^2)` would underflow for
/// outlying samples.
fn nearest_rows(features: &Features, n_neighbors: usize) -> Vec<Vec<Neighbor<f32>>> {
    let rows: Vec<&[f32]> = features.rows().collect();
    let of_row = |i: usize| {
        let apart = |j: usize| (squared(rows[i], rows[j]), j);
        let mut all: Vec<(f32, usize)> = (0..rows.len()).filter(|j| *j != i).map(apart).collect();
        let order = |a: &(f32, usize), b: &(f32, usize)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
        if all.len() > n_neighbors {
            all.select_nth_unstable_by(n_neighbors - 1, order);
            all.truncate(n_neighbors);
        }
        all.sort_unstable_by(order);
        let nearest = all.first().map_or(0.0, |first| first.0);
        all.into_iter().map(|(squared, index)| Neighbor { index, distance: (squared - nearest).sqrt() }).collect()
    };
    (0..rows.len()).into_par_iter().map(of_row).collect()
}

/// PCA initialisation: first two principal components, the first scaled to a deviation of 1e-4 as in other
/// implementations, plus a perturbation a hundredth as large.
fn initial_positions(features: &Features, seed: u64) -> Vec<f32> {
    let (x, _) = features.centered();
    let eigen = SymmetricEigen::new(x.tr_mul(&x));
    let mut order: Vec<usize> = (0..features.dim()).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
    let component = |k: usize| -> Vec<f64> {
        let Some(&column) = order.get(k) else { return vec![0.0; features.len()] };
        let direction = eigen.eigenvectors.column(column);
        // The sign of an eigenvector is arbitrary: its largest entry is made positive.
        let largest = direction.iter().copied().fold(0.0, |a: f64, b| if b.abs() > a.abs() { b } else { a });
        (&x * direction).iter().map(|v| v * largest.signum()).collect()
    };
    let (first, second) = (component(0), component(1));
    let spread = (first.iter().map(|v| v * v).sum::<f64>() / first.len() as f64).sqrt();
    let scale = if spread > 0.0 { 1e-4 / spread } else { 0.0 };
    let mut rng = stream(seed, "tsne", 0, 0);
    let mut shift = || rng.random_range(-1e-6..1e-6);
    first.iter().zip(&second).flat_map(|(x, y)| [x * scale + shift(), y * scale + shift()]).map(|v| v as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three clusters of 40 in 16 dimensions.
    fn clusters() -> Features {
        let mut rng = stream(1, "tsne test", 0, 0);
        let values = (0..120).flat_map(|i| {
            let mut v: Vec<f32> = (0..16).map(|_| rng.random_range(-1.0..1.0)).collect();
            v[i / 40] += 12.0;
            v
        });
        Features::new(16, values.collect()).unwrap()
    }

    fn options(method: TsneMethod) -> TsneOptions {
        TsneOptions { perplexity: 10.0, steps: 400, seed: 3, method }
    }

    #[test]
    fn clusters_stay_together() {
        let features = clusters();
        for method in [TsneMethod::Exact, TsneMethod::BarnesHut { theta: 0.5 }, TsneMethod::Interpolated] {
            let (places, divergence) = tsne(&features, &options(method)).unwrap();
            let apart = |i: usize, j: usize| (places[i][0] - places[j][0]).hypot(places[i][1] - places[j][1]);
            let own = (0..120).filter(|i| {
                let nearest = (0..120).filter(|j| j != i).min_by(|a, b| apart(*i, *a).total_cmp(&apart(*i, *b)));
                nearest.unwrap() / 40 == i / 40
            });
            assert_eq!(own.count(), 120, "{method:?}");
            assert!((0.0..2.0).contains(&divergence), "{method:?} {divergence}");
        }
    }

    /// The same computed from full matrices.
    #[test]
    fn divergence_is_that_of_all_pairs() {
        let features = clusters();
        let neighbors = nearest_rows(&features, 30);
        let (places, found) = tsne(&features, &options(TsneMethod::Exact)).unwrap();
        let n = places.len();
        let mut p = vec![vec![0.0; n]; n];
        for (i, row) in neighbors.iter().enumerate() {
            let shares = weights(row, 10.0);
            let entropy: f64 = shares.iter().map(|(_, p)| -p * p.ln()).sum();
            assert!((entropy.exp() - 10.0).abs() < 1e-6, "perplexity {}", entropy.exp());
            for (j, share) in shares {
                p[i][j] += share / (2 * n) as f64;
                p[j][i] += share / (2 * n) as f64;
            }
        }
        let q = |i: usize, j: usize| 1.0 / (1.0 + (0..2).map(|k| (places[i][k] - places[j][k]).powi(2)).sum::<f64>());
        let pairs = || (0..n).flat_map(|i| (0..n).map(move |j| (i, j))).filter(|(i, j)| i != j);
        let total: f64 = pairs().map(|(i, j)| q(i, j)).sum();
        let all: f64 = pairs()
            .map(|(i, j)| (p[i][j], q(i, j) / total))
            .filter(|(p, _)| *p > 0.0)
            .map(|(p, q)| p * (p / q).ln())
            .sum();
        assert!((all - found).abs() < 1e-9, "{found} is not {all}");
    }

    /// Eight clusters in 128 dimensions, four of them wide; the affinities of those underflow before normalisation.
    /// scikit-learn 1.9 reaches 1.446 (`TSNE(perplexity=10, init="pca", angle=0.1)`), openTSNE 1.0 1.351
    /// (`theta=0.1`).
    #[test]
    fn divergence_is_as_small_as_that_of_other_implementations() {
        let value = |i: usize, k: usize| {
            let x = (i as f64 * 12.9898 + k as f64 * 78.233).sin() * 43758.5453;
            let group = if k < 4 && i % 4 == k { 1.5 } else { 0.0 };
            ((x - x.floor() - 0.5 + group) * if i < 200 { 1.0 } else { 6.0 }) as f32
        };
        let values = (0..400).flat_map(|i| (0..128).map(move |k| value(i, k)));
        let features = Features::new(128, values.collect()).unwrap();
        for method in [TsneMethod::Exact, TsneMethod::Interpolated] {
            let (_, found) =
                tsne(&features, &TsneOptions { perplexity: 10.0, method, ..TsneOptions::default() }).unwrap();
            assert!((1.3..1.5).contains(&found), "{found} with {method:?}");
        }
    }

    #[test]
    fn a_seed_gives_the_same_bits_for_any_number_of_threads() {
        let features = clusters();
        let run = |threads: usize, seed: u64| {
            let options = TsneOptions { seed, ..options(TsneMethod::BarnesHut { theta: 0.5 }) };
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| tsne(&features, &options).unwrap())
        };
        let one = run(1, 3);
        assert!(one == run(3, 3) && one == run(2, 3), "threads change the picture");
        assert!(one != run(1, 4), "the seed changes nothing");
    }

    #[test]
    fn settings_without_sense_are_refused() {
        let features = clusters();
        let refused = |change: fn(&mut TsneOptions)| {
            let mut options = options(TsneMethod::BarnesHut { theta: 0.5 });
            change(&mut options);
            tsne(&features, &options).unwrap_err().to_string()
        };
        assert!(refused(|o| o.perplexity = 40.0).contains("at least 122 samples, not 120"));
        assert!(refused(|o| o.perplexity = f64::NAN).contains("perplexity"));
        assert!(refused(|o| o.method = TsneMethod::BarnesHut { theta: 0.0 }).contains("theta"));
        let still = Features::new(3, vec![1.0; 3 * 120]).unwrap();
        assert!(tsne(&still, &options(TsneMethod::BarnesHut { theta: 0.5 })).is_ok(), "equal samples are no error");
    }
}
