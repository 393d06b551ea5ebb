//! t-SNE (van der Maaten and Hinton 2008; Barnes-Hut 2014; interpolated, Linderman et al. 2019), through the crate `bhtsne`.

use super::{FeatureError, Features};
use bhtsne::Neighbor;
use data::stream;
use nalgebra::SymmetricEigen;
use rand::RngExt;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Version of [`Embedding`] as JSON.
pub const TSNE_SCHEMA: &str = "lidarshift.tsne/1";

/// How the forces between far points are computed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", tag = "kind", deny_unknown_fields)]
pub enum TsneMethod {
    /// All pairs.
    Exact,
    /// By a tree; nearer to exact the smaller `theta` is, 0.5 as usual.
    BarnesHut {
        /// Over 0.
        theta: f64,
    },
    /// By interpolation on a grid.
    Interpolated,
}

/// Settings of t-SNE.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TsneOptions {
    /// About as many neighbours as each point keeps near.
    pub perplexity: f64,
    /// Steps of the descent.
    pub steps: usize,
    /// Seed of the small shifts by which the beginning differs from the first two principal components.
    pub seed: u64,
    /// How forces are computed.
    pub method: TsneMethod,
}

impl Default for TsneOptions {
    fn default() -> Self {
        TsneOptions { perplexity: 30.0, steps: 1000, seed: 0, method: TsneMethod::BarnesHut { theta: 0.5 } }
    }
}

/// A point of the picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Embedded {
    /// What the network was trained on.
    pub train_set: String,
    /// The seed of the run.
    pub seed: u64,
    /// The test frame.
    pub frame: String,
    /// Place in the picture, without unit.
    pub at: [f64; 2],
}

/// A picture of features, for the report.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Embedding {
    /// [`TSNE_SCHEMA`].
    pub schema: String,
    /// The network.
    pub network: String,
    /// The layer, and how its values become one vector a cloud.
    pub layer: String,
    /// What the networks were tested on.
    pub test_set: String,
    /// By which rules.
    pub options: TsneOptions,
    /// The Kullback-Leibler divergence that is left.
    pub kl_divergence: f64,
    /// All points.
    pub points: Vec<Embedded>,
}

/// Places in the plane for the samples, and the divergence that is left. Neighbours in the features are neighbours in the plane;
/// distances between clusters and their sizes say nothing.
///
/// It begins at the first two principal components. The same numbers for any number of threads: neighbours are searched in parallel,
/// the descent of the library runs on one thread, since its sums over threads have no fixed order.
///
/// # Errors
/// Fewer samples than three times the perplexity, and settings without sense.
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
    let begin = beginning(features, options.seed);
    let rows: Vec<&[f32]> = features.rows().collect();
    let neighbors = match options.method {
        TsneMethod::Exact => Vec::new(),
        _ => nearest_rows(features, n_neighbors),
    };
    let descend = || {
        let mut fit = bhtsne::tSNE::<f32, &[f32], 2>::new(&rows);
        fit.perplexity(options.perplexity as f32).epochs(options.steps).initial_embedding(begin);
        match options.method {
            TsneMethod::Exact => fit.exact(|a, b| squared(a, b).sqrt()),
            TsneMethod::BarnesHut { theta } => fit.barnes_hut_with_neighbors(theta as f32, &neighbors),
            TsneMethod::Interpolated => fit.fit_sne_with_neighbors(&neighbors),
        };
        (fit.embedding(), fit.kl_divergence().unwrap_or(f32::NAN))
    };
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build();
    let one = one.map_err(|e| FeatureError::Setting(format!("no thread could be started: {e}")))?;
    let (places, divergence) = one.install(descend);
    if let Some(i) = places.iter().position(|v| !v.is_finite()) {
        return wrong(format!("the descent left the numbers at sample {}; try another perplexity", i / 2));
    }
    Ok((places.chunks_exact(2).map(|p| [f64::from(p[0]), f64::from(p[1])]).collect(), f64::from(divergence)))
}

fn squared(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
}

/// The nearest rows of every row but itself, by rising distance; of equally near ones the first.
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
        all.into_iter().map(|(squared, index)| Neighbor { index, distance: squared.sqrt() }).collect()
    };
    (0..rows.len()).into_par_iter().map(of_row).collect()
}

/// The first two principal components, the first with deviation 1e-4 as other implementations begin, and shifts a hundredth as large.
fn beginning(features: &Features, seed: u64) -> Vec<f32> {
    let (x, _) = features.centered();
    let eigen = SymmetricEigen::new(x.tr_mul(&x));
    let mut order: Vec<usize> = (0..features.dim()).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
    let component = |k: usize| -> Vec<f64> {
        let Some(&column) = order.get(k) else { return vec![0.0; features.len()] };
        let direction = eigen.eigenvectors.column(column);
        // An eigenvector has no sign of its own: its largest value is made positive.
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
