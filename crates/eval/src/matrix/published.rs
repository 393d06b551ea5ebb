//! The paper's published numbers: its table of all results (appendix), as data.

use super::Quantity;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

const TABLE: &str = include_str!("published.csv");

/// A published value.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Published {
    /// Mean of five runs, percent.
    pub mean: f64,
    /// Their standard deviation, percent.
    pub deviation: f64,
}

/// The published value for a network (`PointRCNN`, `PointPillars`), trained and tested on two of the paper's data sets
/// (`Real`, `Sim`, `Sim Noise`, `Sim Downsampled`): 3D AP40 and OpenPCDet's recall, at overlap 0.5 or 0.7.
pub fn published(
    network: &str,
    train_set: &str,
    test_set: &str,
    quantity: Quantity,
    overlap: f64,
) -> Option<Published> {
    let column = match (quantity, overlap) {
        (Quantity::Ap40, 0.5) => 3,
        (Quantity::Ap40, 0.7) => 5,
        (Quantity::RecallAnyBox, 0.5) => 7,
        (Quantity::RecallAnyBox, 0.7) => 9,
        _ => return None,
    };
    let mut rows = TABLE.lines().skip(1).map(|row| row.split(',').collect::<Vec<_>>());
    let row = rows.find(|row| row[..3] == [network, train_set, test_set])?;
    Some(Published { mean: row[column].parse().ok()?, deviation: row[column + 1].parse().ok()? })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_numbers_of_the_table_are_there() {
        let sets = ["Real", "Sim", "Sim Noise", "Sim Downsampled"];
        let mut n = 0;
        for network in ["PointRCNN", "PointPillars"] {
            for (train, test) in sets.iter().flat_map(|train| sets.map(|test| (train, test))) {
                for quantity in Quantity::PAPER {
                    for overlap in [0.5, 0.7] {
                        let p = published(network, train, test, quantity, overlap).unwrap();
                        assert!((0.0..=100.0).contains(&p.mean) && (0.0..5.0).contains(&p.deviation));
                        n += 1;
                    }
                }
            }
        }
        assert_eq!((n, TABLE.lines().count()), (128, 33));
        let p = published("PointRCNN", "Sim", "Real", Quantity::Ap40, 0.7).unwrap();
        assert_eq!((p.mean, p.deviation), (38.23, 0.98));
        assert!(published("PointRCNN", "Sim", "Mars", Quantity::Ap40, 0.7).is_none());
        assert!(published("PointRCNN", "Sim", "Real", Quantity::ApArea, 0.7).is_none());
    }

    /// Recalls of the paper's PointRCNN are means of five numbers k / 1000. Checks which divisors of the deviation can
    /// give the printed values.
    #[test]
    fn the_paper_divides_by_n() {
        let sets = ["Real", "Sim", "Sim Noise", "Sim Downsampled"];
        let (mut only_n, mut only_less) = (0, 0);
        for (train, test) in sets.iter().flat_map(|train| sets.map(|test| (train, test))) {
            for overlap in [0.5, 0.7] {
                let p = published("PointRCNN", train, test, Quantity::RecallAnyBox, overlap).unwrap();
                let rest = (p.mean * 50.0).round() as i64 % 5; // the sum of the five modulo 5, in thousandths
                // The sum of squared deviations is q - rest^2 / 5, where q has the same parity as the rest.
                let fits = |divisor: f64| {
                    (0..20_000).filter(|q| (q - rest) % 2 == 0).any(|q| {
                        let squares = q as f64 - (rest * rest) as f64 / 5.0;
                        squares >= 0.0 && ((squares / divisor).sqrt() / 10.0 - p.deviation).abs() <= 0.005 + 1e-9
                    })
                };
                only_n += usize::from(fits(5.0) && !fits(4.0));
                only_less += usize::from(fits(4.0) && !fits(5.0));
            }
        }
        assert!(only_n >= 4 && only_less == 0, "{only_n} need n, {only_less} need n - 1");
    }
}
