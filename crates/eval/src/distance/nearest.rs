//! Nearest-neighbour search between clouds.

use super::{DistanceError, Point, check};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;

/// The nearest neighbour in the other cloud.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Nearest {
    /// Its index in the other cloud.
    pub index: usize,
    /// Its squared distance, m2.
    pub squared_m2: f32,
}

/// The nearest neighbour in `to` of every point of `from`. Ties are broken arbitrarily.
///
/// # Errors
/// An empty cloud or a non-finite position.
pub fn nearest(from: &[Point], to: &[Point]) -> Result<Vec<Nearest>, DistanceError> {
    check(from)?;
    check(to)?;
    let tree: ImmutableKdTree<f32, 3> = ImmutableKdTree::new_from_slice(to)
        .map_err(|e| DistanceError::Tree { n: to.len(), message: format!("{e:?}") })?;
    let ask = |p: &Point| {
        let found = tree.query(p).nearest_one::<SquaredEuclidean<f32>>().execute();
        Nearest { index: found.item as usize, squared_m2: found.distance }
    };
    Ok(from.par_iter().with_min_len(1024).map(ask).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn cloud(least: usize) -> impl Strategy<Value = Vec<Point>> {
        // A coarse grid: many equal distances, as in the cloud of a wall.
        prop::collection::vec(prop::array::uniform3((-20i8..20).prop_map(|v| f32::from(v) / 4.0)), least..200)
    }

    proptest! {
        #[test]
        fn is_what_looking_at_all_points_finds(a in cloud(1), b in cloud(1)) {
            for (p, found) in a.iter().zip(nearest(&a, &b).unwrap()) {
                let squared = |q: &Point| (0..3).map(|k| (p[k] - q[k]) * (p[k] - q[k])).sum::<f32>();
                let want = b.iter().map(squared).fold(f32::INFINITY, f32::min);
                prop_assert!((found.squared_m2 - want).abs() < 1e-5);
                prop_assert!((squared(&b[found.index]) - want).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn nothing_and_no_number_are_refused() {
        let good = vec![[0.0, 1.0, 2.0]; 300];
        assert_eq!(nearest(&good, &good).unwrap()[299].squared_m2, 0.0);
        for bad in [vec![], vec![[0.0, f32::NAN, 0.0]], vec![[f32::INFINITY, 0.0, 0.0]]] {
            assert!(nearest(&bad, &good).is_err() && nearest(&good, &bad).is_err());
        }
        let error = nearest(&good, &[[0.0; 3], [0.0, f32::NAN, 0.0]]).unwrap_err().to_string();
        assert!(error.starts_with("point 1 of 2"), "{error}");
    }
}
