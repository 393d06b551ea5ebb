//! Tails of the roughness: single returns far off their surface, by the usual roughness of the shots around them and by
//! their distance.
//!
//! The usual roughness is the median over the shots before and after in the same row: it follows what a surface, its
//! brightness and its incidence do to the noise. It is at least that of the noisier side at such ranges and angles:
//! what is uneven in the world is off by the same lengths on both sides, and is a tail on both or on neither. It is
//! also at least what a neighbour that is far off makes of it. A return beyond [`BEYOND`] standard deviations of it is
//! in the tail.

use super::cells::{cell, place_of};
use super::roughness::own_roughness_m;
use crate::pairing::{FramePair, Ray, STRAY_M, Surface, company_m};
use rayon::prelude::*;
use sensor::directions::EDGE_M;

/// Standard deviations from which on a return is in the tail.
pub const BEYOND: f64 = 6.0;

/// Smallest distance of a return in the tail from its surface, along the ray, m: walls have a relief, of which the two
/// sides show different parts.
const LEAST_OFF_M: f64 = 0.06;

/// Shots before and after one whose surface it may be part of: where it is far off they have none, or are drawn to it.
const BESIDE: usize = 2;

/// Shots before and after these that tell the usual roughness.
const AROUND: usize = 8;

/// Fewest of these with a roughness.
const FEWEST: usize = 10;

/// Bins of the logarithm of the usual roughness: four for each factor of 2, from 1 mm.
const BINS: usize = 40;

fn bin_of(usual_m: f64) -> usize {
    ((usual_m / 1e-3).log2() * 4.0).clamp(0.0, BINS as f64 - 1.0) as usize
}

/// Bins of the size of what is in the tail: four for each factor of 2, from 1 cm.
pub const SIZES: usize = 28;

/// Lower end of a bin of sizes, m.
pub fn size_m(bin: usize) -> f64 {
    0.01 * (bin as f64 / 4.0).exp2()
}

fn size_bin(size_m: f64) -> usize {
    ((size_m / 0.01).log2() * 4.0).clamp(0.0, SIZES as f64 - 1.0) as usize
}

/// Measured returns with the same usual distance from the surface through their neighbours.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TailBin {
    /// Returns.
    pub all: f64,
    /// Standard deviation of the usual distance, m, summed over them.
    pub usual_m: f64,
    /// The same returns by the size of [`most_m`], up to which they are looked at.
    pub most: [f64; SIZES],
}

impl TailBin {
    /// Adds another bin.
    pub fn merge(&mut self, other: &TailBin) {
        (self.all, self.usual_m) = (self.all + other.all, self.usual_m + other.usual_m);
        self.most.iter_mut().zip(other.most).for_each(|(sum, n)| *sum += n);
    }
}

/// Share of the distance from which on returns are left out within which none is.
const SURELY: f64 = 0.8;

/// Largest distance along the ray, at a range and a cosine of incidence, up to which a return surely is of the surface
/// through its neighbours, m: it is not far across that surface, and not alone at its range. Returns that are farther
/// off are not counted.
pub fn most_m(range_m: f64, cos: f64) -> f64 {
    SURELY * (STRAY_M / cos.max(0.05)).min(company_m(range_m))
}

/// Tails of one side of a frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Tail {
    /// Returns.
    pub all: f64,
    /// Of these in the tail.
    pub beyond: f64,
    /// The same by their distance from the surface through their neighbours: see [`size_m`].
    pub sizes: [f64; SIZES],
    /// Shots that follow one in the tail, and those of them that are in it as well.
    pub next: [f64; 2],
    /// All returns by their usual distance.
    pub bins: Vec<TailBin>,
}

impl Default for Tail {
    fn default() -> Self {
        Tail { all: 0.0, beyond: 0.0, sizes: [0.0; SIZES], next: [0.0; 2], bins: vec![TailBin::default(); BINS] }
    }
}

/// Kinds of surfaces: ground, what stands, labelled objects.
pub const KINDS: usize = 3;

fn kind_of(surface: Surface) -> usize {
    match surface {
        Surface::Ground => 0,
        Surface::Standing | Surface::Open => 1,
        Surface::Object => 2,
    }
}

/// Tails of both sides of a frame, measured first, by the kind of the surface.
pub type FrameTails = [[Tail; 2]; KINDS];

/// Tails of each frame. `scales` holds the usual roughness of the noisier side by cell, m: see
/// [`super::roughness::scales`].
pub fn tails(frames: &[FramePair], scales: &[f64]) -> Vec<FrameTails> {
    let of_frame = |frame: &FramePair| {
        let [measured, simulated] = [&frame.measured, &frame.simulated].map(|rays| tails_of(rays, scales));
        let mut of_sides = measured.into_iter().zip(simulated).map(|(a, b)| [a, b]);
        std::array::from_fn(|_| of_sides.next().unwrap_or_default())
    };
    frames.par_iter().map(of_frame).collect()
}

/// Rays in the order in which a row sends them; of sensors without rows as they are recorded.
fn in_order(rays: &[Ray]) -> Vec<&Ray> {
    let mut order: Vec<&Ray> = rays.iter().collect();
    order.sort_by(|a, b| {
        let by_azimuth =
            || if a.row == u16::MAX { std::cmp::Ordering::Equal } else { a.azimuth_rad.total_cmp(&b.azimuth_rad) };
        (a.sensor, a.row).cmp(&(b.sensor, b.row)).then_with(by_azimuth)
    });
    order
}

fn tails_of(rays: &[Ray], scales: &[f64]) -> [Tail; KINDS] {
    let shots: Vec<(&Ray, Option<f64>)> = in_order(rays).into_iter().map(|ray| (ray, own_roughness_m(ray))).collect();
    let mut of_kinds: [Tail; KINDS] = Default::default();
    let (mut before, mut around) = (false, Vec::with_capacity(2 * AROUND));
    for (i, (ray, own)) in shots.iter().enumerate() {
        let row = |j: &usize| shots[*j].0.row == ray.row && shots[*j].0.sensor == ray.sensor;
        let window = i.saturating_sub(BESIDE + AROUND)..(i + BESIDE + AROUND + 1).min(shots.len());
        around.clear();
        let apart = |j: &usize| j.abs_diff(i) > BESIDE;
        around.extend(window.filter(apart).filter(row).filter_map(|j| shots[j].1).map(f64::abs));
        let (Some(own), Some((range_m, cos, _)), true) = (own, place_of(ray), around.len() >= FEWEST) else {
            before = false;
            continue;
        };
        let half = around.len() / 2;
        let median = *around.select_nth_unstable_by(half, f64::total_cmp).1;
        let of_cell_m = cell(ray).map_or(0.0, |c| scales[c]);
        // A neighbour that is less than an edge off draws the surface by its weight in the mean, which is at most the
        // root of its variance: at grazing incidence by much along the ray.
        let drawn_m = EDGE_M * f64::from(ray.roughness_leverage).sqrt() / cos;
        let least_m = drawn_m.max(LEAST_OFF_M) / BEYOND;
        let usual_m = (median / statistics::MEDIAN_OF_NORMAL).max(of_cell_m).max(least_m);
        // The distance itself: a single error has no part in the surface, whose own error the usual ones have.
        let times = (1.0 + f64::from(ray.roughness_leverage)).sqrt();
        let [off_m, usual_m] = [times * own.abs(), times * usual_m];
        let beyond = off_m > BEYOND * usual_m;
        let most_m = most_m(range_m, cos);
        if off_m > most_m {
            before = false;
            continue;
        }
        let out = &mut of_kinds[kind_of(ray.surface)];
        let bin = &mut out.bins[bin_of(usual_m)];
        (bin.all, bin.usual_m) = (bin.all + 1.0, bin.usual_m + usual_m);
        bin.most[size_bin(most_m)] += 1.0;
        out.all += 1.0;
        if before {
            out.next[0] += 1.0;
            out.next[1] += f64::from(u8::from(beyond));
        }
        if beyond {
            out.beyond += 1.0;
            out.sizes[size_bin(off_m)] += 1.0;
        }
        before = beyond;
    }
    of_kinds
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    /// A row of a wall 10 m away with 8 mm of noise. One return is off by so much; the shots beside it have no surface.
    fn row_with(off_m: f32, cos_incidence: f32) -> Tail {
        let ray = |k: i32| {
            let azimuth = 0.003 * f64::from(k);
            let beside = (18..=22).contains(&k) && k != 20;
            let roughness_m = match k {
                20 => off_m,
                _ if beside => f32::NAN,
                _ => 0.008 * if k % 2 == 0 { 1.0 } else { -1.0 },
            };
            let ray = Ray::standing(&(Vector3::new(azimuth.cos(), azimuth.sin(), 0.0) * 10.0));
            Ray { roughness_m, roughness_leverage: 0.1, cos_incidence, ..ray }
        };
        let rays: Vec<Ray> = (0..40).map(ray).collect();
        let [_, standing, _] = tails_of(&rays, &vec![0.0; super::super::cells::CELLS]);
        standing
    }

    #[test]
    fn a_far_return_counts_where_those_beside_it_have_no_surface() {
        let tail = row_with(0.3, 1.0);
        assert_eq!((tail.beyond, tail.sizes[size_bin(0.3)]), (1.0, 1.0), "{tail:?}");
        let near = row_with(0.008, 1.0);
        assert_eq!((near.beyond, near.all), (0.0, tail.all));
    }

    #[test]
    fn what_a_far_neighbour_does_to_a_surface_at_grazing_incidence_is_no_tail() {
        // 0.12 m across the surface, of which the square root of 0.1 may be in its mean: 19 cm along the ray.
        let [square, grazing] = [1.0, 0.2].map(|cos| row_with(0.15, cos));
        assert_eq!([square.beyond, grazing.beyond], [1.0, 0.0]);
        assert_eq!(row_with(0.25, 0.2).beyond, 1.0);
    }
}
