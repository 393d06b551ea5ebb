//! Vector registers of pixels: loads, stores and (de)interleaving of rows of images and panels.

use crate::output::Shared;
use crate::tile::Row;
use pulp::Simd;
use pulp::bytemuck::cast;
use std::any::Any;

/// A row of one channel of one image within a tensor.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ImageRow {
    /// Index of its first pixel.
    pub start: usize,
    /// Number of pixels.
    pub width: usize,
}

/// The pixels from `first` on, which may be -1; zeros beyond the ends of the row.
#[inline(always)]
pub(crate) fn load<S: Simd>(simd: S, tensor: &[f32], row: ImageRow, first: isize) -> S::f32s {
    let (lanes, width) = (S::F32_LANES as isize, row.width as isize);
    if first >= 0 && first + lanes <= width {
        let at = row.start + first as usize;
        return S::as_simd_f32s(&tensor[at..at + S::F32_LANES]).0[0];
    }
    let (from, to) = ((-first).clamp(0, lanes), (width - first).clamp(0, lanes));
    if from >= to {
        return simd.splat_f32s(0.0);
    }
    let inside = &tensor[(row.start as isize + first + from) as usize..][..(to - from) as usize];
    let place = inside.as_ptr().wrapping_sub(from as usize);
    #[cfg(target_arch = "x86_64")]
    if let Some(v4) = (&simd as &dyn Any).downcast_ref::<pulp::x86::V4>() {
        let mask = (1u16 << (to - 1) << 1).wrapping_sub(1 << from);
        // SAFETY: the lanes of the mask are those of `inside`; no other is read.
        return cast(unsafe { v4.avx512f._mm512_maskz_loadu_ps(mask, place) });
    }
    let mask = simd.mask_between_m32s(from as u32, to as u32);
    // SAFETY: as above.
    unsafe { simd.mask_load_ptr_f32s(mask, place) }
}

/// Stores the lanes inside the row and before `end`.
///
/// # Safety
/// As [`Shared::write`].
#[inline(always)]
pub(crate) unsafe fn store<S: Simd>(
    simd: S,
    tensor: &Shared<'_>,
    row: ImageRow,
    (first, end): (usize, usize),
    values: S::f32s,
) {
    let count = end.min(row.width).saturating_sub(first).min(S::F32_LANES);
    if count == 0 {
        return;
    }
    // SAFETY: required of the caller.
    let place = unsafe { tensor.part(row.start + first, count) };
    let place: *mut f32 = place.as_mut_ptr().cast();
    if count == S::F32_LANES {
        // SAFETY: the slice has as many elements as the register, and its type needs no alignment.
        unsafe { place.cast::<S::f32s>().write_unaligned(values) };
        return;
    }
    #[cfg(target_arch = "x86_64")]
    if let Some(v4) = (&simd as &dyn Any).downcast_ref::<pulp::x86::V4>() {
        // SAFETY: only the `count` lanes of the slice are written.
        unsafe { v4.avx512f._mm512_mask_storeu_ps(place, (1 << count) - 1, cast(values)) };
        return;
    }
    // SAFETY: as above.
    unsafe { simd.mask_store_ptr_f32s(simd.mask_between_m32s(0, count as u32), place, values) };
}

/// Prefetches an address that will be read or written later; any address is valid. The rows of an image's channels are
/// far apart, in more streams than hardware prefetchers follow.
#[inline(always)]
pub(crate) fn prefetch(place: *const f32) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: a hint, which never faults.
    unsafe {
        std::arch::x86_64::_mm_prefetch::<{ std::arch::x86_64::_MM_HINT_T1 }>(place.cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = place;
}

/// The values of a panel's row from `at` on; zeros after its end.
#[inline(always)]
pub(crate) fn load_row<S: Simd>(simd: S, row: &Row, at: usize) -> S::f32s {
    load(simd, row, ImageRow { start: 0, width: row.len() }, at as isize)
}

/// Writes values to a panel's row from `at` on, up to its end.
#[inline(always)]
pub(crate) fn store_row<S: Simd>(simd: S, row: &mut Row, at: usize, values: S::f32s) {
    match row.get_mut(at..at + S::F32_LANES) {
        Some(places) => S::as_mut_simd_f32s(places).0[0] = values,
        None => {
            let rest = &mut row[at..];
            #[cfg(target_arch = "x86_64")]
            if let Some(v4) = (&simd as &dyn Any).downcast_ref::<pulp::x86::V4>() {
                // SAFETY: `rest` has fewer elements than the register has lanes; only these are written.
                unsafe { v4.avx512f._mm512_mask_storeu_ps(rest.as_mut_ptr(), (1 << rest.len()) - 1, cast(values)) };
                return;
            }
            simd.partial_store_f32s(rest, values);
        }
    }
}

/// Deinterleaves `M` registers of adjacent pixels: the j-th result has pixels j, M + j, 2 M + j, ... M is 1, 2 or 4.
#[inline(always)]
pub(crate) fn deinterleave<S: Simd, const M: usize>(simd: S, pixels: [S::f32s; M]) -> [S::f32s; M] {
    let mut apart = pixels;
    match M {
        2 => (apart[0], apart[1]) = pairs_apart(simd, pixels[0], pixels[1]),
        4 => {
            let (even, odd) = pairs_apart(simd, pixels[0], pixels[1]);
            let (even_behind, odd_behind) = pairs_apart(simd, pixels[2], pixels[3]);
            (apart[0], apart[2]) = pairs_apart(simd, even, even_behind);
            (apart[1], apart[3]) = pairs_apart(simd, odd, odd_behind);
        }
        _ => {}
    }
    apart
}

/// The inverse of [`deinterleave`].
#[inline(always)]
pub(crate) fn interleave<S: Simd, const M: usize>(simd: S, apart: [S::f32s; M]) -> [S::f32s; M] {
    let mut pixels = apart;
    match M {
        2 => (pixels[0], pixels[1]) = pairs_together(simd, apart[0], apart[1]),
        4 => {
            let (even, even_behind) = pairs_together(simd, apart[0], apart[2]);
            let (odd, odd_behind) = pairs_together(simd, apart[1], apart[3]);
            (pixels[0], pixels[1]) = pairs_together(simd, even, odd);
            (pixels[2], pixels[3]) = pairs_together(simd, even_behind, odd_behind);
        }
        _ => {}
    }
    pixels
}

/// The even and the odd elements of the concatenation of `a` and `b`.
#[inline(always)]
fn pairs_apart<S: Simd>(simd: S, a: S::f32s, b: S::f32s) -> (S::f32s, S::f32s) {
    #[cfg(target_arch = "x86_64")]
    if let Some(v4) = (&simd as &dyn Any).downcast_ref::<pulp::x86::V4>() {
        const EVEN: [i32; 16] = [0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30];
        const ODD: [i32; 16] = [1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31];
        let even = v4.avx512f._mm512_permutex2var_ps(cast(a), cast(EVEN), cast(b));
        let odd = v4.avx512f._mm512_permutex2var_ps(cast(a), cast(ODD), cast(b));
        return (cast(even), cast(odd));
    }
    #[cfg(target_arch = "x86_64")]
    if let Some(v3) = (&simd as &dyn Any).downcast_ref::<pulp::x86::V3>() {
        let even = v3.avx._mm256_shuffle_ps::<0b10_00_10_00>(cast(a), cast(b));
        let odd = v3.avx._mm256_shuffle_ps::<0b11_01_11_01>(cast(a), cast(b));
        let even = v3.avx2._mm256_permute4x64_pd::<0b11_01_10_00>(cast(even));
        let odd = v3.avx2._mm256_permute4x64_pd::<0b11_01_10_00>(cast(odd));
        return (cast(even), cast(odd));
    }
    let (mut from, mut even, mut odd) = ([0.0; 32], [0.0; 16], [0.0; 16]);
    S::as_mut_simd_f32s(&mut from).0[0] = a;
    S::as_mut_simd_f32s(&mut from).0[1] = b;
    for lane in 0..S::F32_LANES {
        (even[lane], odd[lane]) = (from[2 * lane], from[2 * lane + 1]);
    }
    (S::as_simd_f32s(&even).0[0], S::as_simd_f32s(&odd).0[0])
}

/// The inverse of [`pairs_apart`].
#[inline(always)]
fn pairs_together<S: Simd>(simd: S, even: S::f32s, odd: S::f32s) -> (S::f32s, S::f32s) {
    #[cfg(target_arch = "x86_64")]
    if let Some(v4) = (&simd as &dyn Any).downcast_ref::<pulp::x86::V4>() {
        const FIRST: [i32; 16] = [0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23];
        const SECOND: [i32; 16] = [8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31];
        let first = v4.avx512f._mm512_permutex2var_ps(cast(even), cast(FIRST), cast(odd));
        let second = v4.avx512f._mm512_permutex2var_ps(cast(even), cast(SECOND), cast(odd));
        return (cast(first), cast(second));
    }
    #[cfg(target_arch = "x86_64")]
    if let Some(v3) = (&simd as &dyn Any).downcast_ref::<pulp::x86::V3>() {
        let low = v3.avx._mm256_unpacklo_ps(cast(even), cast(odd));
        let high = v3.avx._mm256_unpackhi_ps(cast(even), cast(odd));
        let first = v3.avx._mm256_permute2f128_ps::<0x20>(low, high);
        return (cast(first), cast(v3.avx._mm256_permute2f128_ps::<0x31>(low, high)));
    }
    let mut to = [0.0; 32];
    let (mut e, mut o) = ([0.0; 16], [0.0; 16]);
    (S::as_mut_simd_f32s(&mut e).0[0], S::as_mut_simd_f32s(&mut o).0[0]) = (even, odd);
    for lane in 0..S::F32_LANES {
        (to[2 * lane], to[2 * lane + 1]) = (e[lane], o[lane]);
    }
    (S::as_simd_f32s(&to).0[0], S::as_simd_f32s(&to).0[1])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::fill;
    use crate::simd::dispatch;
    use pulp::WithSimd;

    struct Checks;

    impl WithSimd for Checks {
        type Output = ();

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) {
            zeros_beyond_the_ends(simd);
            apart_and_together::<S, 1>(simd);
            apart_and_together::<S, 2>(simd);
            apart_and_together::<S, 4>(simd);
            only_places_in_the_row(simd);
        }
    }

    fn lanes<S: Simd>(values: S::f32s) -> Vec<f32> {
        let mut all = [0.0; 16];
        S::as_mut_simd_f32s(&mut all).0[0] = values;
        all[..S::F32_LANES].to_vec()
    }

    fn zeros_beyond_the_ends<S: Simd>(simd: S) {
        for (width, rows) in [(1, 1), (3, 2), (40, 3)] {
            let tensor: Vec<f32> = (0..width * rows).map(|i| i as f32 + 1.0).collect();
            for row in 0..rows {
                for first in -1..width as isize + 2 {
                    let got = lanes::<S>(load(simd, &tensor, ImageRow { start: row * width, width }, first));
                    for (k, got) in got.into_iter().enumerate() {
                        let x = first + k as isize;
                        let inside = x >= 0 && x < width as isize;
                        let want = if inside { tensor[row * width + x as usize] } else { 0.0 };
                        assert_eq!(got, want, "width {width} row {row} first {first} lane {k}");
                    }
                }
            }
        }
    }

    fn apart_and_together<S: Simd, const M: usize>(simd: S) {
        let values: Vec<f32> = (0..64).map(|i| i as f32).collect();
        let pixels: [S::f32s; M] = std::array::from_fn(|k| S::as_simd_f32s(&values).0[k]);
        let apart = deinterleave(simd, pixels);
        for (j, register) in apart.iter().enumerate() {
            let want: Vec<f32> = (0..S::F32_LANES).map(|t| (t * M + j) as f32).collect();
            assert_eq!(lanes::<S>(*register), want);
        }
        let together = interleave(simd, apart);
        assert!(together.iter().zip(pixels).all(|(a, b)| lanes::<S>(*a) == lanes::<S>(b)));
    }

    fn only_places_in_the_row<S: Simd>(simd: S) {
        let mut row = [0.0; 32];
        for at in 0..32 {
            row.fill(0.0);
            store_row(simd, &mut row, at, simd.splat_f32s(1.0));
            let want: Vec<f32> = (0..32).map(|i| if i >= at && i < at + S::F32_LANES { 1.0 } else { 0.0 }).collect();
            assert_eq!(row.to_vec(), want);
            row = std::array::from_fn(|i| i as f32);
            assert_eq!(lanes::<S>(load_row(simd, &row, at))[0], at as f32);
        }
        let mut out = Vec::new();
        // SAFETY: all ten values are written, by one thread.
        unsafe {
            fill(&mut out, 10, |out| {
                let out = Shared::new(out);
                out.write(0, &[0.0; 10]);
                store(simd, &out, ImageRow { start: 2, width: 6 }, (1, 40), simd.splat_f32s(1.0));
                store(simd, &out, ImageRow { start: 9, width: 1 }, (3, 9), simd.splat_f32s(5.0));
            });
        }
        let end = 3 + S::F32_LANES.min(5);
        assert_eq!(out, (0..10).map(|i| if i >= 3 && i < end { 1.0 } else { 0.0 }).collect::<Vec<_>>());
    }

    #[test]
    fn registers_equals_the_definition() {
        dispatch(Checks);
    }
}
