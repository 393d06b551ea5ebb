//! The plot of a finding of noise: roughness along its covariate, before and after.

use crate::curve::{Curve, CurvePoint};
use crate::inference::noise::{NoiseLaw, NoiseTable};
use statistics::weighted_median;

/// Standard deviation along the covariate of a law.
pub(super) fn curve(table: &NoiseTable, law: NoiseLaw, terms: &[(NoiseLaw, f64)]) -> Curve {
    let angular = law == NoiseLaw::Angular;
    let x_of = |range: f64, cos: f64| if angular { range * (1.0 / (cos * cos) - 1.0).max(0.0).sqrt() } else { range };
    let mut rows: Vec<(f64, f64, f64, f64, f64)> = table
        .rows()
        .into_iter()
        .map(|(range, cos, n, [va, vb])| {
            let added: f64 = terms.iter().map(|(l, t)| t * l.variance(range, cos)).sum();
            (x_of(range, cos), n, va, vb, (vb + added).max(0.0))
        })
        .collect();
    rows.sort_by(|a, b| a.0.total_cmp(&b.0));
    let per = (rows.iter().map(|r| r.1).sum::<f64>() / 14.0).max(1.0);
    let mut points = Vec::new();
    let mut cells: Vec<(f64, f64, f64, f64, f64)> = Vec::new();
    for (i, row) in rows.iter().enumerate() {
        cells.push(*row);
        let n: f64 = cells.iter().map(|c| c.1).sum();
        if n >= per || i + 1 == rows.len() && n > 0.2 * per {
            // A median: cells with an edge are rough on both sides and would dominate a mean.
            let sd = |of: fn(&(f64, f64, f64, f64, f64)) -> f64| {
                weighted_median(cells.iter().map(|c| (of(c), c.1)).collect()).unwrap_or(0.0).sqrt()
            };
            let measured = sd(|c| c.2);
            points.push(CurvePoint {
                sensor: 0,
                x: cells.iter().map(|c| c.0 * c.1).sum::<f64>() / n,
                measured,
                before: sd(|c| c.3),
                after: sd(|c| c.4),
                error: measured / n.sqrt(),
            });
            cells.clear();
        }
    }
    let x = if angular { "range x tan(incidence), m" } else { "range, m" };
    Curve { x: x.into(), y: "standard deviation along the ray, m".into(), by_sensor: false, points }
}
