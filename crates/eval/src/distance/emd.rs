//! Earth mover's distance by exact assignment.

use super::{DistanceError, Point, apart_m, check};

/// Minimum over all one-to-one assignments of `a` to `b` of the mean point distance, m. Exact, by shortest augmenting
/// paths (Jonker and Volgenant 1987, in the form of Crouse 2016). Run time is cubic in the number of points: use a few
/// thousand at most.
///
/// # Errors
/// Clouds of different size, an empty cloud, or a non-finite position.
pub fn emd(a: &[Point], b: &[Point]) -> Result<f64, DistanceError> {
    check(a)?;
    check(b)?;
    if a.len() != b.len() {
        return Err(DistanceError::Sizes { a: a.len(), b: b.len() });
    }
    let n = a.len();
    let costs: Vec<f64> = a.iter().flat_map(|p| b.iter().map(|q| apart_m(p, q))).collect();
    // Uses the widest available SIMD instructions.
    let row_of = pulp::Arch::new().dispatch(|| cheapest_assignment(&costs, n));
    Ok(row_of.iter().enumerate().map(|(column, row)| costs[row * n + column]).sum::<f64>() / n as f64)
}

/// Marks an unassigned row or column.
const NONE: usize = usize::MAX;

/// Minimum-cost assignment: the row of each column of `costs`, `[n, n]` and finite.
#[inline(always)]
fn cheapest_assignment(costs: &[f64], n: usize) -> Vec<usize> {
    // Dual variables u of rows and v of columns: u + v <= cost everywhere, with equality for assigned pairs.
    let mut v = vec![f64::INFINITY; n];
    for row in costs.chunks_exact(n) {
        v.iter_mut().zip(row).for_each(|(v, cost)| *v = v.min(*cost));
    }
    let (mut u, mut row_of, mut column_of) = (vec![0.0; n], vec![NONE; n], vec![NONE; n]);
    let mut reduced = vec![0.0; n];
    for (i, row) in costs.chunks_exact(n).enumerate() {
        (0..n).for_each(|j| reduced[j] = row[j] - v[j]);
        let column;
        (column, u[i]) = least(&reduced);
        if row_of[column] == NONE {
            (row_of[column], column_of[i]) = (i, column);
        }
    }
    // Per column: length of the shortest path, the same if the column is still open (else infinity), and the previous
    // row.
    let (mut shortest, mut open, mut before) = (vec![0.0; n], vec![0.0; n], vec![NONE; n]);
    let mut closed = vec![false; n];
    for start in 0..n {
        if column_of[start] != NONE {
            continue;
        }
        // Dijkstra over reduced costs, from the row to the nearest free column.
        shortest.fill(f64::INFINITY);
        closed.fill(false);
        let (mut row, mut length, mut visited) = (start, 0.0, vec![]);
        let end = loop {
            let base = length - u[row];
            let costs = &costs[row * n..][..n];
            for j in 0..n {
                let through = base + costs[j] - v[j];
                let better = (through < shortest[j]) & !closed[j];
                shortest[j] = if better { through } else { shortest[j] };
                before[j] = if better { row } else { before[j] };
                open[j] = if closed[j] { f64::INFINITY } else { shortest[j] };
            }
            let column;
            (column, length) = least(&open);
            closed[column] = true;
            if row_of[column] == NONE {
                break column;
            }
            visited.push(column);
            row = row_of[column];
        };
        u[start] += length;
        for &column in &visited {
            u[row_of[column]] += length - shortest[column];
            v[column] -= length - shortest[column];
        }
        let mut column = end;
        loop {
            let row = before[column];
            row_of[column] = row;
            std::mem::swap(&mut column_of[row], &mut column);
            if row == start {
                break;
            }
        }
    }
    row_of
}

/// Index of the smallest value (the first one if tied), and the value.
#[inline(always)]
fn least(values: &[f64]) -> (usize, f64) {
    let min = |a: f64, b: f64| if b < a { b } else { a };
    let (chunks, rest) = values.as_chunks::<8>();
    let mut lanes = [f64::INFINITY; 8];
    for chunk in chunks {
        lanes = std::array::from_fn(|k| min(lanes[k], chunk[k]));
    }
    let least = lanes.iter().chain(rest).copied().fold(f64::INFINITY, min);
    (values.iter().position(|value| *value == least).unwrap_or(0), least)
}

#[cfg(test)]
mod tests {
    use super::*;
    use data::stream;
    use rand::RngExt;

    /// Minimum over all permutations, by brute force.
    fn tried(a: &[Point], b: &[Point], used: &mut Vec<bool>, k: usize) -> f64 {
        if k == a.len() {
            return 0.0;
        }
        let mut best = f64::INFINITY;
        for j in 0..b.len() {
            if !used[j] {
                used[j] = true;
                best = best.min(apart_m(&a[k], &b[j]) + tried(a, b, used, k + 1));
                used[j] = false;
            }
        }
        best
    }

    #[test]
    fn is_the_cheapest_of_all_permutations() {
        for seed in 0..30 {
            let mut rng = stream(seed, "emd test", 0, 0);
            let n = rng.random_range(1..8);
            let mut cloud =
                || -> Vec<Point> { (0..n).map(|_| [0; 3].map(|_: i32| rng.random_range(-3..3) as f32)).collect() };
            let (a, b) = (cloud(), cloud());
            let want = tried(&a, &b, &mut vec![false; n], 0) / n as f64;
            assert!((emd(&a, &b).unwrap() - want).abs() < 1e-9, "seed {seed}");
        }
    }

    #[test]
    fn a_shift_costs_its_length() {
        let a: Vec<Point> = (0..300).map(|i| [i as f32 * 0.1, (i % 7) as f32, 0.0]).collect();
        let b: Vec<Point> = a.iter().rev().map(|p| [p[0], p[1], p[2] + 0.25]).collect();
        assert!((emd(&a, &b).unwrap() - 0.25).abs() < 1e-6);
        assert!(matches!(emd(&a, &b[1..]), Err(DistanceError::Sizes { .. })));
    }
}
