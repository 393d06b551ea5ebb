//! Fits of causes and the choice between them.

pub mod banded;
pub mod choice;
pub mod comb;
pub mod counts;
mod descent;
pub mod grouped;
pub mod law;
pub mod linear;
pub mod losses;
pub mod noise;
pub mod roles;
pub mod simplex;

/// Where a condition that holds below some place between two ends, and not above it, ends; by halving so many times.
pub fn bisect([mut low, mut high]: [f64; 2], times: usize, holds: impl Fn(f64) -> bool) -> f64 {
    for _ in 0..times {
        let middle = 0.5 * (low + high);
        if holds(middle) { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

/// At most so many of some items, evenly spread.
pub fn evenly_spread<T: Clone>(items: &[T], most: usize) -> Vec<T> {
    let (n, kept) = (items.len(), items.len().min(most));
    (0..kept).map(|k| items[k * n / kept].clone()).collect()
}

/// Median of some values, the upper one of the two in the middle; 0 of none.
pub fn median(values: Vec<f64>) -> f64 {
    statistics::median_upper(values).unwrap_or(0.0)
}
