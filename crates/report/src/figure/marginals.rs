//! Target positions in bird's eye view, with the marginal distribution of each coordinate.

use super::{Figure, color, legend};
use crate::axis::Axis;
use crate::page::{Anchor, GRID, INK, Page};

/// Target positions of one data set.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct LocatedTargets {
    /// Name in the legend.
    pub name: String,
    /// x (forward) and y (left), m, LiDAR frame.
    pub at_m: Vec<[f64; 2]>,
}

const SIDE: f64 = 520.0;
const MARGIN: f64 = 100.0;
const BINS: usize = 40;

/// Targets of one or more data sets within `range_m` of the sensor: x (driving direction) to the right, y upwards.
/// Above and to the right: the fraction of targets in each of forty bins.
pub fn locations(sets: &[LocatedTargets], range_m: f64) -> Figure {
    let mut page = Page::new([SIDE + MARGIN + 90.0, SIDE + MARGIN + 80.0], [255; 3], false);
    let names: Vec<&str> = sets.iter().map(|s| s.name.as_str()).collect();
    let used = legend(&mut page, &names, [60.0, 6.0], SIDE);
    page.size[1] += used;
    let (left, top) = (60.0, used + MARGIN);
    let (right, bottom) = (left + SIDE, top + SIDE);
    let x_axis = Axis::new([-range_m, range_m].into_iter(), [left, right], false);
    let y_axis = Axis::new([-range_m, range_m].into_iter(), [left, right], false);
    let y_px = |v: f64| bottom - (y_axis.px(v) - left);
    for (value, name) in x_axis.ticks() {
        let (x, y) = (x_axis.px(value), y_px(value));
        page.line(vec![[x, top], [x, bottom]], GRID, 1.0);
        page.line(vec![[left, y], [right, y]], GRID, 1.0);
        page.text([x, bottom + 18.0], name.clone(), 12.0, INK, Anchor::Middle);
        page.text([left - 8.0, y + 4.0], name, 12.0, INK, Anchor::End);
    }
    page.line(vec![[left, top], [right, top], [right, bottom], [left, bottom], [left, top]], INK, 1.0);
    page.text([(left + right) / 2.0, bottom + 40.0], "x (m), forward", 13.0, INK, Anchor::Middle);
    page.text_upwards([18.0, (top + bottom) / 2.0], "y (m), left", 13.0);
    let (u, v) = (x_axis.px(0.0), y_px(0.0));
    page.shape(vec![[u + 8.0, v], [u - 6.0, v - 5.0], [u - 3.0, v], [u - 6.0, v + 5.0]], INK, 1.0, 1.0);
    let inside = |p: &&[f64; 2]| p.iter().all(|v| v.abs() <= range_m);
    for (k, set) in sets.iter().enumerate() {
        let many = set.at_m.len() > 1500;
        let centers = set.at_m.iter().filter(inside).map(|p| [x_axis.px(p[0]), y_px(p[1])]).collect();
        page.dots(centers, if many { 1.5 } else { 2.4 }, color(k), if many { 0.35 } else { 0.6 });
    }
    let shares: Vec<[Vec<f64>; 2]> =
        sets.iter().map(|set| [0, 1].map(|axis| histogram(&set.at_m, axis, range_m))).collect();
    let highest = shares.iter().flatten().flatten().copied().fold(1e-9, f64::max);
    for (k, [of_x, of_y]) in shares.iter().enumerate() {
        let high = |share: f64| share / highest * (MARGIN - 16.0);
        let step = SIDE / BINS as f64;
        let stairs = |shares: &[f64]| -> Vec<[f64; 2]> {
            let steps = shares.iter().enumerate();
            steps.flat_map(|(i, s)| [[i as f64 * step, high(*s)], [(i + 1) as f64 * step, high(*s)]]).collect()
        };
        let above = stairs(of_x).into_iter().map(|[at, h]| [left + at, top - 6.0 - h]).collect();
        let beside = stairs(of_y).into_iter().map(|[at, h]| [right + 6.0 + h, bottom - at]).collect();
        page.line(above, color(k), 1.6);
        page.line(beside, color(k), 1.6);
    }
    Figure(page)
}

/// Fraction of the targets per bin.
fn histogram(at_m: &[[f64; 2]], axis: usize, range_m: f64) -> Vec<f64> {
    let mut counts = vec![0.0; BINS];
    for p in at_m.iter().filter(|p| p.iter().all(|v| v.abs() <= range_m)) {
        let bin = ((p[axis] + range_m) / (2.0 * range_m) * BINS as f64) as usize;
        counts[bin.min(BINS - 1)] += 1.0;
    }
    let n = counts.iter().sum::<f64>().max(1.0);
    counts.iter().map(|c| c / n).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn forward_is_right_and_left_is_up() {
        let set = LocatedTargets { name: "real".into(), at_m: vec![[50.0, 20.0], [50.0, 30.0], [400.0, 0.0]] };
        let figure = locations(&[set], 100.0);
        let mut dots = figure.0.marks.iter().filter_map(|mark| match mark {
            crate::page::Mark::Dots { centers, .. } if centers.len() == 2 => Some(centers),
            _ => None,
        });
        let centers = dots.next_back().unwrap();
        let middle = 60.0 + SIDE / 2.0;
        assert!((centers[0][0] - middle - SIDE / 4.0).abs() < 1e-6 && centers[1][1] < centers[0][1]);
        assert_eq!(histogram(&[[0.0, 99.9], [0.0, 100.0]], 1, 100.0)[BINS - 1], 1.0);
        assert!(!locations(&[], 100.0).svg().contains("NaN"));
    }
}
