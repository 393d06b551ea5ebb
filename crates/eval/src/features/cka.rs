//! Linear centred kernel alignment (Kornblith et al. 2019).

use super::{FeatureError, Features};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Similarity of two layers on the same samples, 0 to 1: |YᵀX|² / (|XᵀX| |YᵀY|) of the centred features, Frobenius
/// norms. Invariant to rotation and isotropic scaling of the features. Biased upwards if there are fewer samples than
/// features.
///
/// # Errors
/// Different samples, fewer than two samples, or a layer with zero variance.
pub fn linear_cka(a: &Features, b: &Features) -> Result<f64, FeatureError> {
    if a.len() != b.len() {
        return Err(FeatureError::Unpaired { a: a.len(), b: b.len() });
    }
    if a.len() < 2 {
        return Err(FeatureError::TooFew { what: "linear CKA", least: 2, n: a.len() });
    }
    let ((x, _), (y, _)) = (a.centered(), b.centered());
    // The same three norms from [dim, dim] or from [N, N], whichever is smaller.
    let [xy, xx, yy] = if a.len() < a.dim().max(b.dim()) {
        let (k, l) = (&x * x.transpose(), &y * y.transpose());
        [k.dot(&l), k.norm(), l.norm()]
    } else {
        [x.tr_mul(&y).norm_squared(), x.tr_mul(&x).norm(), y.tr_mul(&y).norm()]
    };
    if !(xx > 0.0 && yy > 0.0) {
        return Err(FeatureError::Values("all samples of one layer have the same features".into()));
    }
    Ok(xy / (xx * yy))
}

/// Linear CKA of every layer of one network with every layer of another.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct CkaTable {
    /// Layers of the first network.
    pub layers_a: Vec<String>,
    /// Layers of the second.
    pub layers_b: Vec<String>,
    /// One row per entry of `layers_a`; `None` if a layer has zero variance.
    pub values: Vec<Vec<Option<f64>>>,
}

/// CKA table of two networks on the same samples; layers are given with their names.
///
/// # Errors
/// Layers with different numbers of samples, or fewer than two.
pub fn cka_table(a: &[(String, Features)], b: &[(String, Features)]) -> Result<CkaTable, FeatureError> {
    let cell = |x: &Features, y: &Features| match linear_cka(x, y) {
        Ok(value) => Ok(Some(value)),
        Err(FeatureError::Values(_)) => Ok(None),
        Err(e) => Err(e),
    };
    let row = |(_, x): &(String, Features)| b.iter().map(|(_, y)| cell(x, y)).collect::<Result<Vec<_>, _>>();
    let values: Vec<Result<Vec<_>, FeatureError>> = a.par_iter().map(row).collect();
    let names = |layers: &[(String, Features)]| layers.iter().map(|(name, _)| name.clone()).collect();
    Ok(CkaTable { layers_a: names(a), layers_b: names(b), values: values.into_iter().collect::<Result<_, _>>()? })
}

#[cfg(test)]
mod tests {
    use super::*;
    use data::stream;
    use rand::RngExt;

    fn random(n: usize, dim: usize, seed: u64) -> Features {
        let mut rng = stream(seed, "cka test", 0, 0);
        Features::new(dim, (0..n * dim).map(|_| rng.random_range(-1.0..1.0f32)).collect()).unwrap()
    }

    #[test]
    fn a_turned_and_scaled_layer_is_the_same() {
        for (n, dim) in [(50, 2), (5, 8)] {
            let a = random(n, dim, 1);
            let turned = a.rows().flat_map(|v| {
                let mut v: Vec<f32> = v.iter().map(|v| 3.0 * v + 1.0).collect();
                (v[0], v[1]) = (0.6 * v[0] - 0.8 * v[1], 0.8 * v[0] + 0.6 * v[1]);
                v
            });
            let b = Features::new(dim, turned.collect()).unwrap();
            assert!((linear_cka(&a, &b).unwrap() - 1.0).abs() < 1e-5);
        }
        // Both ways of computing agree: an additional column of zeros changes which matrix is smaller.
        let (a, b) = (random(10, 9, 1), random(10, 4, 2));
        let wide = Features::new(12, a.rows().flat_map(|v| v.iter().copied().chain([0.0; 3])).collect()).unwrap();
        assert!((linear_cka(&a, &b).unwrap() - linear_cka(&wide, &b).unwrap()).abs() < 1e-9);
        assert!(linear_cka(&random(2000, 3, 1), &random(2000, 3, 2)).unwrap() < 0.01);
    }

    #[test]
    fn odd_input_is_refused() {
        let (a, still) = (random(9, 2, 1), Features::new(2, vec![1.0; 18]).unwrap());
        assert!(matches!(linear_cka(&a, &random(8, 2, 1)), Err(FeatureError::Unpaired { .. })));
        let table = cka_table(&[("a".into(), a.clone())], &[("still".into(), still), ("a".into(), a)]).unwrap();
        assert!(table.values[0][0].is_none() && table.values[0][1].unwrap() > 0.999);
        assert!(Features::new(2, vec![1.0, f32::NAN]).is_err() && Features::new(2, vec![1.0]).is_err());
    }
}
