//! Winograd's minimal filtering F(m x m, 3x3) (Lavin & Gray, "Fast Algorithms for Convolutional Neural Networks",
//! 2016): the transforms.

use std::ops::{Add, Mul, Sub};

/// Element type of the transforms: single values or registers.
pub(crate) trait Value: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<f32, Output = Self> {}

impl<T: Copy + Add<Output = T> + Sub<Output = T> + Mul<f32, Output = T>> Value for T {}

/// The transforms of F(M x M, 3x3) along one axis, with A = M + 2.
pub(crate) trait Winograd<const M: usize, const A: usize>: Copy + Send + Sync {
    /// G, `[A, 3]`.
    const KERNEL: [[f32; 3]; A];

    /// B^T d.
    fn input<T: Value>(d: [T; A]) -> [T; A];

    /// A^T m.
    fn output<T: Value>(m: [T; A]) -> [T; M];

    /// A g, the transpose of [`Winograd::output`].
    fn gradient<T: Value>(g: [T; M]) -> [T; A];
}

/// F(2 x 2, 3 x 3): 2.25 times fewer multiplications, rounding error about that of the direct sum.
#[derive(Clone, Copy, Debug)]
pub(crate) struct F2;

impl Winograd<2, 4> for F2 {
    const KERNEL: [[f32; 3]; 4] = [[1.0, 0.0, 0.0], [0.5, 0.5, 0.5], [0.5, -0.5, 0.5], [0.0, 0.0, 1.0]];

    #[inline(always)]
    fn input<T: Value>(d: [T; 4]) -> [T; 4] {
        [d[0] - d[2], d[1] + d[2], d[2] - d[1], d[1] - d[3]]
    }

    #[inline(always)]
    fn output<T: Value>(m: [T; 4]) -> [T; 2] {
        [m[0] + (m[1] + m[2]), (m[1] - m[2]) - m[3]]
    }

    #[inline(always)]
    fn gradient<T: Value>(g: [T; 2]) -> [T; 4] {
        [g[0], g[0] + g[1], g[0] - g[1], g[1] * -1.0]
    }
}

/// F(4 x 4, 3 x 3): 4 times fewer multiplications, rounding error about ten times larger.
#[derive(Clone, Copy, Debug)]
pub(crate) struct F4;

impl Winograd<4, 6> for F4 {
    const KERNEL: [[f32; 3]; 6] = [
        [0.25, 0.0, 0.0],
        [-1.0 / 6.0, -1.0 / 6.0, -1.0 / 6.0],
        [-1.0 / 6.0, 1.0 / 6.0, -1.0 / 6.0],
        [1.0 / 24.0, 1.0 / 12.0, 1.0 / 6.0],
        [1.0 / 24.0, -1.0 / 12.0, 1.0 / 6.0],
        [0.0, 0.0, 1.0],
    ];

    #[inline(always)]
    fn input<T: Value>(d: [T; 6]) -> [T; 6] {
        let (p, q) = (d[4] - d[2] * 4.0, d[3] - d[1] * 4.0);
        let (r, s) = (d[4] - d[2], (d[3] - d[1]) * 2.0);
        [d[0] * 4.0 + (d[4] - d[2] * 5.0), p + q, p - q, r + s, r - s, d[1] * 4.0 + (d[5] - d[3] * 5.0)]
    }

    #[inline(always)]
    fn output<T: Value>(m: [T; 6]) -> [T; 4] {
        let (s1, d1, s2, d2) = (m[1] + m[2], m[1] - m[2], m[3] + m[4], m[3] - m[4]);
        [m[0] + (s1 + s2), d1 + d2 * 2.0, s1 + s2 * 4.0, d1 + d2 * 8.0 + m[5]]
    }

    #[inline(always)]
    fn gradient<T: Value>(g: [T; 4]) -> [T; 6] {
        let (even, odd) = (g[0] + g[2], g[1] + g[3]);
        let (even2, odd2) = (g[0] + g[2] * 4.0, g[1] * 2.0 + g[3] * 8.0);
        [g[0], even + odd, even - odd, even2 + odd2, even2 - odd2, g[3]]
    }
}

/// G w G^T of one kernel `[3, 3]`.
#[inline(always)]
pub(crate) fn transform_kernel<F: Winograd<M, A>, const M: usize, const A: usize>(w: &[f32; 9]) -> [[f32; A]; A] {
    let mut u = [[0.0; A]; A];
    for (g, u) in F::KERNEL.iter().zip(&mut u) {
        let mut row = [0.0; 3]; // of G w
        for (c, value) in row.iter_mut().enumerate() {
            *value = g[0] * w[c] + g[1] * w[3 + c] + g[2] * w[6 + c];
        }
        for (g, u) in F::KERNEL.iter().zip(u) {
            *u = g[0] * row[0] + g[1] * row[1] + g[2] * row[2];
        }
    }
    u
}

/// G^T u G, the transpose of [`transform_kernel`].
#[inline(always)]
pub(crate) fn transform_kernel_back<F: Winograd<M, A>, T: Value, const M: usize, const A: usize>(
    u: &[[T; A]; A],
) -> [T; 9] {
    let mut weights = [u[0][0]; 9];
    for r in 0..3 {
        let mut row = u[0]; // of G^T u
        for c in 0..A {
            row[c] = u[0][c] * F::KERNEL[0][r];
            for a in 1..A {
                row[c] = row[c] + u[a][c] * F::KERNEL[a][r];
            }
        }
        for c in 0..3 {
            let mut sum = row[0] * F::KERNEL[0][c];
            for a in 1..A {
                sum = sum + row[a] * F::KERNEL[a][c];
            }
            weights[r * 3 + c] = sum;
        }
    }
    weights
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A^T [(G w G^T) . (B^T d B)] A is the convolution, and `gradient` is the transpose of `output`.
    fn check<F: Winograd<M, A>, const M: usize, const A: usize>() {
        let w: [f32; 9] = std::array::from_fn(|i| ((i * 7 + 3) % 11) as f32 - 5.0);
        let d: [[f32; A]; A] =
            std::array::from_fn(|i| std::array::from_fn(|j| ((i * 5 + j * 3 + i * j) % 7) as f32 - 3.0));
        let column = |m: &[[f32; A]; A], j: usize| std::array::from_fn::<f32, A, _>(|i| m[i][j]);
        let v: [[f32; A]; A] = std::array::from_fn(|j| F::input(column(&d, j))); // columns of B^T d
        let v: [[f32; A]; A] = std::array::from_fn(|i| F::input(std::array::from_fn(|j| v[j][i])));
        let u = transform_kernel::<F, M, A>(&w);
        let m: [[f32; A]; A] = std::array::from_fn(|i| std::array::from_fn(|j| u[i][j] * v[i][j]));
        let y: [[f32; M]; A] = std::array::from_fn(|j| F::output(column(&m, j)));
        for i in 0..M {
            let row = F::output(std::array::from_fn(|j| y[j][i]));
            for j in 0..M {
                let want: f32 = (0..9).map(|k| w[k] * d[i + k / 3][j + k % 3]).sum();
                assert!((row[j] - want).abs() < 2e-4 * want.abs().max(10.0), "{i} {j}: {} {want}", row[j]);
            }
        }
        for i in 0..M {
            let unit = std::array::from_fn(|k| if k == i { 1.0 } else { 0.0 });
            let transposed = F::gradient(unit);
            for a in 0..A {
                assert_eq!(transposed[a], F::output(std::array::from_fn(|k| if k == a { 1.0 } else { 0.0 }))[i]);
            }
        }
        let g: [[f32; A]; A] = std::array::from_fn(|i| std::array::from_fn(|j| (i + 2 * j) as f32 - 4.0));
        let back = transform_kernel_back::<F, f32, M, A>(&g);
        let (a, b): (f32, f32) = (
            back.iter().zip(&w).map(|(a, b)| a * b).sum(),
            g.as_flattened().iter().zip(u.as_flattened()).map(|(a, b)| a * b).sum(),
        );
        assert!((a - b).abs() < 1e-3, "{a} {b}");
    }

    #[test]
    fn both_sizes_give_the_convolution() {
        check::<F2, 2, 4>();
        check::<F4, 4, 6>();
    }
}
