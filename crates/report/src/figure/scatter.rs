//! Scatter plots without axis units, for t-SNE.

use super::{Figure, color, legend};
use crate::page::{INK, Page};

/// Points of one colour.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct ScatterGroup {
    /// Name in the legend.
    pub name: String,
    /// Positions; non-finite ones are skipped.
    pub points: Vec<[f64; 2]>,
}

const SIZE: f64 = 640.0;

/// A square plot with equal scale on both axes and no ticks: t-SNE coordinates have no meaning by themselves.
pub fn scatter(groups: &[ScatterGroup]) -> Figure {
    let finite = |p: &&[f64; 2]| p.iter().all(|v| v.is_finite());
    let all = || groups.iter().flat_map(|g| &g.points).filter(finite);
    let ends =
        |k: usize| all().map(|p| p[k]).fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
    let ((x0, x1), (y0, y1)) = (ends(0), ends(1));
    let side = (x1 - x0).max(y1 - y0).max(1e-9);
    let mut page = Page::new([SIZE, SIZE], [255; 3], false);
    let names: Vec<&str> = groups.iter().map(|g| g.name.as_str()).collect();
    let top = legend(&mut page, &names, [12.0, 6.0], SIZE - 24.0);
    page.size[1] = SIZE + top;
    let inside = SIZE - 24.0;
    let px = |p: &[f64; 2]| {
        let place = |v: f64, low: f64, high: f64| (v - (low + high) / 2.0) / side * (inside - 20.0) + SIZE / 2.0;
        [place(p[0], x0, x1), SIZE - place(p[1], y0, y1) + top - 4.0]
    };
    let many = all().count();
    let radius = if many > 4000 {
        1.3
    } else if many > 800 {
        1.8
    } else {
        2.6
    };
    for (k, group) in groups.iter().enumerate() {
        page.dots(group.points.iter().filter(finite).map(px).collect(), radius, color(k), 0.65);
    }
    let (left, right, bottom) = (12.0, SIZE - 12.0, SIZE + top - 12.0);
    page.line(vec![[left, top], [right, top], [right, bottom], [left, bottom], [left, top]], INK, 0.8);
    Figure(page)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_points_lie_in_the_frame() {
        let points = (0..50).map(|i| [f64::from(i) * 3.0 - 20.0, f64::from(i * i)]).chain([[f64::NAN, 0.0]]).collect();
        let figure = scatter(&[ScatterGroup { name: "real".into(), points }, ScatterGroup::default()]);
        let drawn = figure.0.marks.iter().filter_map(|mark| match mark {
            crate::page::Mark::Dots { centers, .. } if centers.len() > 1 => Some(centers),
            _ => None,
        });
        let centers: Vec<_> = drawn.flatten().collect();
        assert_eq!(centers.len(), 50);
        assert!(centers.iter().all(|c| (12.0..628.0).contains(&c[0]) && c[1] > 0.0 && c[1] < figure.0.size[1] - 12.0));
        assert!(!scatter(&[]).svg().contains("NaN"));
    }
}
