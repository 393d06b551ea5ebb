//! Chamfer distances.

use super::{DistanceError, Nearest, Point, nearest};

/// Chamfer distances of two clouds A and B, in the variants that the literature calls by this name.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Chamfer {
    /// Sum of the squared distances from every point to its nearest neighbour in the other cloud, both directions, m2.
    /// Grows with the number of points. The paper's value of 2.3 million is of this variant.
    pub sum_m2: f64,
    /// Mean squared distance from the points of A to their nearest neighbours in B, m2.
    pub a_to_b_m2: f64,
    /// From B to A, m2.
    pub b_to_a_m2: f64,
    /// Sum of the two means, m2.
    pub mean_m2: f64,
    /// Mean distance (not squared), averaged over both directions, m.
    pub mean_m: f64,
    /// Density-aware Chamfer distance (Wu et al. 2021), 0 to 1: mean of 1 - exp(-distance / 1 m) / n, where n is the
    /// number of points with the same nearest neighbour, averaged over both directions. Bounded for far points, and
    /// sensitive to density differences.
    pub density_aware: f64,
}

/// Chamfer distances of two clouds.
///
/// # Errors
/// An empty cloud or a non-finite position.
pub fn chamfer(a: &[Point], b: &[Point]) -> Result<Chamfer, DistanceError> {
    let (forth, back) = rayon::join(|| nearest(a, b), || nearest(b, a));
    Ok(Chamfer::of_nearest(&forth?, &back?))
}

impl Chamfer {
    /// From the nearest neighbours in both directions: `forth` of A's points in B, `back` of B's points in A.
    pub(super) fn of_nearest(forth: &[Nearest], back: &[Nearest]) -> Self {
        let sum = |from: &[Nearest]| from.iter().map(|n| f64::from(n.squared_m2)).sum::<f64>();
        let sum_m = |from: &[Nearest]| from.iter().map(|n| f64::from(n.squared_m2).sqrt()).sum::<f64>();
        let (n_a, n_b) = (forth.len() as f64, back.len() as f64);
        let (a_to_b_m2, b_to_a_m2) = (sum(forth) / n_a, sum(back) / n_b);
        Chamfer {
            sum_m2: sum(forth) + sum(back),
            a_to_b_m2,
            b_to_a_m2,
            mean_m2: a_to_b_m2 + b_to_a_m2,
            mean_m: (sum_m(forth) / n_a + sum_m(back) / n_b) / 2.0,
            density_aware: (density_aware(forth, back.len()) + density_aware(back, forth.len())) / 2.0,
        }
    }
}

fn density_aware(from: &[Nearest], n_to: usize) -> f64 {
    let mut asked = vec![0u32; n_to];
    from.iter().for_each(|n| asked[n.index] += 1);
    let cost = |n: &Nearest| 1.0 - (-f64::from(n.squared_m2).sqrt()).exp() / f64::from(asked[n.index]);
    from.iter().map(cost).sum::<f64>() / from.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_clouds() {
        let a = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]];
        let b = [[0.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]];
        let c = chamfer(&a, &b).unwrap();
        assert_eq!((c.a_to_b_m2, c.sum_m2), (0.5, 1.0 + 13.0));
        assert!((c.b_to_a_m2 - 13.0 / 3.0).abs() < 1e-12 && (c.mean_m2 - 0.5 - 13.0 / 3.0).abs() < 1e-12);
        assert!((c.mean_m - (0.5 + 5.0 / 3.0) / 2.0).abs() < 1e-12);
        let forth = (1.0 - 1.0 / 2.0 + 1.0 - (-1f64).exp() / 2.0) / 2.0;
        let back = (1.0 - 1.0 / 3.0 + 1.0 - (-2f64).exp() / 3.0 + 1.0 - (-3f64).exp() / 3.0) / 3.0;
        assert!((c.density_aware - (forth + back) / 2.0).abs() < 1e-12, "{c:?}");
        let same = chamfer(&b, &b).unwrap();
        assert_eq!((same.sum_m2, same.density_aware), (0.0, 0.0));
    }
}
