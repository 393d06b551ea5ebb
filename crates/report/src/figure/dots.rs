//! Dot plots: a dot per run and a line at the mean, as in the paper's figures of AP by distance.

use super::{Figure, color, legend};
use crate::axis::Axis;
use crate::page::{Anchor, GRID, INK, Page};

/// The runs of one train and test set combination.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct DotGroup {
    /// Label below the axis.
    pub label: String,
    /// Index into the legend names; sets the colour.
    pub series: usize,
    /// One value per run; may be empty.
    pub values: Vec<f64>,
    /// Position of the mean line.
    pub mean: Option<f64>,
    /// Bounds of the interval of the mean.
    pub interval: Option<[f64; 2]>,
    /// Upper bound, drawn as a dashed line.
    pub ceiling: Option<f64>,
}

/// One panel.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct DotPanel {
    /// Title.
    pub title: String,
    /// Groups; the same in every panel.
    pub groups: Vec<DotGroup>,
}

const ROW: f64 = 300.0;
const WIDTH: f64 = 980.0;
/// Minimum margin left of the first axis.
const MARGIN: f64 = 56.0;

/// Dot panels on a common vertical axis from 0 to 100; `series` are the legend names.
pub fn dots(panels: &[DotPanel], series: &[&str], y_label: &str) -> Figure {
    let most = panels.iter().map(|p| p.groups.len()).max().unwrap_or(0);
    let longest = panels.iter().flat_map(|p| &p.groups).map(|g| g.label.chars().count()).max().unwrap_or(0);
    let columns = match most {
        0..=5 => 4,
        6..=10 => 2,
        _ => 1,
    }
    .min(panels.len().max(1));
    let rows = panels.len().div_ceil(columns);
    // Labels are vertical if there is room, otherwise slanted.
    let width_beside = |margin: f64| (WIDTH - 4.0 - margin) / columns as f64;
    let step_within = |panel_width: f64| (panel_width - 24.0) / most.max(1) as f64;
    let leaning = longest as f64 * 6.4 > step_within(width_beside(MARGIN));
    // A slanted label extends to the left of its group.
    let reach = longest as f64 * 5.4 - step_within(width_beside(MARGIN)) / 2.0;
    let margin = if leaning { MARGIN.max(reach) } else { MARGIN };
    let panel_width = width_beside(margin);
    let step = step_within(panel_width);
    let below = if leaning { 24.0 + longest as f64 * 4.6 } else { 30.0 };
    let row_height = ROW + below;
    let mut page = Page::new([WIDTH, 16.0 + rows as f64 * row_height + 60.0], [255; 3], false);
    let used = legend(&mut page, series, [60.0, 6.0], WIDTH - 80.0);
    page.size[1] = used + 10.0 + rows as f64 * row_height;
    for (i, panel) in panels.iter().enumerate() {
        let (row, column) = (i / columns, i % columns);
        let (left, top) = (margin + column as f64 * panel_width, used + 26.0 + row as f64 * row_height);
        let (right, bottom) = (left + panel_width - 24.0, top + ROW - 50.0);
        let axis = Axis::new([0.0, 100.0].into_iter(), [bottom, top], false);
        for (value, name) in axis.ticks() {
            let y = axis.px(value);
            page.line(vec![[left, y], [right, y]], GRID, 1.0);
            if column == 0 {
                page.text([left - 8.0, y + 4.0], name, 12.0, INK, Anchor::End);
            }
        }
        if column == 0 {
            page.text_upwards([left - 38.0, (top + bottom) / 2.0], y_label, 12.0);
        }
        page.line(vec![[left, top], [left, bottom], [right, bottom]], INK, 1.0);
        page.text([(left + right) / 2.0, top - 8.0], &panel.title, 13.0, INK, Anchor::Middle);
        for (k, group) in panel.groups.iter().enumerate() {
            let x = left + (k as f64 + 0.5) * step;
            draw_group(&mut page, group, &axis, x, step);
            if leaning {
                page.text_leaning([x + 4.0, bottom + 14.0], &group.label, 11.0);
            } else {
                page.text([x, bottom + 18.0], &group.label, 12.0, INK, Anchor::Middle);
            }
        }
    }
    Figure(page)
}

fn draw_group(page: &mut Page, group: &DotGroup, axis: &Axis, x: f64, step: f64) {
    let half = (step * 0.38).min(26.0);
    let color = color(group.series);
    if let Some(ceiling) = group.ceiling.filter(|c| *c < 100.0) {
        let y = axis.px(ceiling);
        let dashes = (0..4).map(|i| x - half + f64::from(i) * half / 2.0);
        dashes.for_each(|from| page.line(vec![[from, y], [from + half / 4.0, y]], INK, 1.0));
    }
    if let Some([low, high]) = group.interval {
        let (low, high) = (axis.px(low), axis.px(high));
        page.shape(vec![[x - half, low], [x + half, low], [x + half, high], [x - half, high]], color, 0.0, 0.15);
    }
    let n = group.values.len();
    let spread = |i: usize| if n > 1 { (i as f64 / (n - 1) as f64 - 0.5) * half * 1.2 } else { 0.0 };
    let centers = group.values.iter().enumerate().filter(|(_, v)| v.is_finite());
    page.dots(centers.map(|(i, v)| [x + spread(i), axis.px(*v)]).collect(), 3.2, color, 0.85);
    if let Some(mean) = group.mean {
        page.line(vec![[x - half, axis.px(mean)], [x + half, axis.px(mean)]], color, 2.5);
    } else {
        page.text([x, axis.px(2.0)], "–", 14.0, INK, Anchor::Middle);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_run_has_a_dot_and_a_missing_cell_a_dash() {
        let group = |values: &[f64], mean| DotGroup {
            label: "sim → real".into(),
            values: values.into(),
            mean,
            interval: mean.map(|m: f64| [m - 1.0, m + 1.0]),
            ..DotGroup::default()
        };
        let panel = DotPanel {
            title: "[0, 33.3) m".into(),
            groups: vec![group(&[40.0, 42.0, 41.0], Some(41.0)), group(&[], None)],
        };
        for n in [1, 4, 9] {
            let text = dots(&vec![panel.clone(); n], &["sim"], "AP").svg();
            assert_eq!(text.matches("h.01").count(), 3 * n + 1, "three dots a panel and one in the legend");
            assert_eq!(text.matches('–').count(), n);
            assert!(!text.contains("NaN"));
        }
        assert!(dots(&[], &[], "AP").svg().contains("</svg>"));
    }
}
