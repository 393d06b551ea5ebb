//! The picture of a finding of noise: roughness over what it depends on, before and after.

use crate::diagnosis::{Curve, CurvePoint};
use crate::inference::noise::{NoiseLaw, NoiseTable};

/// Standard deviation along what the law depends on.
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
    let mut sum = [0.0f64; 5];
    for (i, (x, n, va, vb, vc)) in rows.iter().enumerate() {
        for (s, v) in sum.iter_mut().zip([1.0, *x, *va, *vb, *vc]) {
            *s += n * v;
        }
        if sum[0] >= per || i + 1 == rows.len() && sum[0] > 0.2 * per {
            let [n, x, va, vb, vc] = sum;
            let sd = |v: f64| (v / n).sqrt();
            points.push(CurvePoint {
                x: x / n,
                measured: sd(va),
                before: sd(vb),
                after: sd(vc),
                error: sd(va) / n.sqrt(),
            });
            sum = [0.0; 5];
        }
    }
    let x = if angular { "range x tan(incidence), m" } else { "range, m" };
    Curve { x: x.into(), y: "standard deviation along the ray, m".into(), points }
}
