//! Peaks of the heat maps (Law and Deng, "CornerNet", 2018; OpenPCDet: `gaussian_radius`, `draw_gaussian_to_heatmap`).

/// The radius in cells within which a centre may move so that a box of `dx` x `dy` cells keeps about `overlap` of
/// itself: the smallest of three roots.
///
/// The reference divides the second and the third root by 2 instead of 2 a. Published weights were trained with it, so
/// it is kept. All in f32, in the reference's order of operations; NaN if a root is.
pub fn gaussian_radius(dx: f32, dy: f32, overlap: f32) -> f32 {
    // The reference's constants are f64 of the decimal number, rounded where they meet an f32.
    let o = overlap.to_string().parse::<f64>().unwrap_or(overlap.into());
    let sum = dx + dy;
    let c1 = dy * dx * (1.0 - o) as f32 / (1.0 + o) as f32;
    let r1 = (sum + (sum * sum - 4.0 * c1).sqrt()) / 2.0;
    let b2 = 2.0 * sum;
    let c2 = (1.0 - o) as f32 * dy * dx;
    let r2 = (b2 + (b2 * b2 - 16.0 * c2).sqrt()) / 2.0;
    let b3 = (-2.0 * o) as f32 * sum;
    let c3 = (o - 1.0) as f32 * dy * dx;
    let r3 = (b3 + (b3 * b3 - (16.0 * o) as f32 * c3).sqrt()) / 2.0;
    let smaller = |a: f32, b: f32| if a.is_nan() || b.is_nan() { f32::NAN } else { a.min(b) };
    smaller(smaller(r1, r2), r3)
}

/// Raises `heat_map`, `[rows, columns]`, to a gaussian around a cell: 1 at the cell, deviation a sixth of the diameter
/// `2 radius + 1`. Values are computed in f64 and rounded once.
pub fn draw_peak(heat_map: &mut [f32], [rows, columns]: [usize; 2], [row, column]: [usize; 2], radius: usize) {
    let deviation = (2 * radius + 1) as f64 / 6.0;
    let square = |a: usize, b: usize| (a as f64 - b as f64).powi(2);
    for y in row.saturating_sub(radius)..rows.min(row + radius + 1) {
        for x in column.saturating_sub(radius)..columns.min(column + radius + 1) {
            let value = (-(square(x, column) + square(y, row)) / (2.0 * deviation * deviation)).exp() as f32;
            let cell = &mut heat_map[y * columns + x];
            *cell = cell.max(value);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn radii() {
        // The smallest root, by the formulas with every step rounded to f32.
        for (dx, dy, overlap, want) in [
            (12.1875, 5.0, 0.1, 3.270399f32),
            (2.5, 1.875, 0.1, 0.933232f32),
            (6.1, 2.5, 0.5, 1.508614f32),
            (8.0, 1.0, 0.7, 0.512488f32),
        ] {
            let got = gaussian_radius(dx, dy, overlap);
            assert!((got - want).abs() < 2e-6, "{dx} {dy} {overlap}: {got}");
        }
        // With equal sides s and overlap o: r3 = -2 o s + s sqrt(4 o^2 + 4 o (1 - o)) = 2 s (sqrt(o) - o).
        for (s, o) in [(4.0f32, 0.1f32), (10.0, 0.5), (1.0, 0.7)] {
            let r3 = 2.0 * s * (o.sqrt() - o);
            let r1 = s * (1.0 + (1.0 - (1.0 - o) / (1.0 + o)).sqrt());
            assert!((gaussian_radius(s, s, o) - r3.min(r1)).abs() < 1e-5, "{s} {o}");
        }
        assert_eq!(gaussian_radius(3.0, 7.0, 0.1), gaussian_radius(7.0, 3.0, 0.1));
        assert!(gaussian_radius(f32::NAN, 1.0, 0.1).is_nan());
    }

    #[test]
    fn a_peak_and_its_edges() {
        let mut map = vec![0.0; 5 * 6];
        draw_peak(&mut map, [5, 6], [1, 4], 2);
        assert_eq!(map[6 + 4], 1.0);
        let deviation = 5.0f64 / 6.0;
        let at = |dx: f64, dy: f64| (-(dx * dx + dy * dy) / (2.0 * deviation * deviation)).exp() as f32;
        assert_eq!((map[5], map[6 + 2], map[3 * 6 + 5]), (at(1.0, 1.0), at(2.0, 0.0), at(1.0, 2.0)));
        assert_eq!((map[6 + 1], map[4 * 6 + 4]), (0.0, 0.0), "outside the radius");
    }

    #[test]
    fn the_larger_of_two_peaks_remains() {
        let mut map = vec![0.0; 7];
        draw_peak(&mut map, [1, 7], [0, 1], 2);
        let one = map.clone();
        draw_peak(&mut map, [1, 7], [0, 4], 2);
        assert_eq!((map[1], map[4]), (1.0, 1.0));
        assert!(map.iter().zip(&one).all(|(both, one)| both >= one));
        assert_eq!(map[2], one[2], "the nearer one decides");
    }

    #[test]
    fn a_radius_of_zero_is_one_cell() {
        let mut map = vec![0.0; 9];
        draw_peak(&mut map, [3, 3], [2, 2], 0);
        assert_eq!(map.iter().sum::<f32>(), 1.0);
    }
}
