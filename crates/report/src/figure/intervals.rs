//! Differences with their intervals, one below the other, around a line at zero.

use super::{Figure, color, legend};
use crate::axis::Axis;
use crate::page::{Anchor, GRID, INK, Page};

/// One difference.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct IntervalRow {
    /// Label to the left.
    pub name: String,
    /// Position of the dot; `None`: unknown, drawn as a dash.
    pub value: Option<f64>,
    /// Ends of the line.
    pub interval: Option<[f64; 2]>,
    /// Text to the right.
    pub text: String,
    /// Index into the legend names; sets the colour.
    pub series: usize,
}

const WIDTH: f64 = 860.0;
const ROW: f64 = 24.0;

/// Rows on a common axis that includes zero; `series` are the legend names.
pub fn intervals(rows: &[IntervalRow], series: &[&str], x_label: &str) -> Figure {
    let widest = |texts: &mut dyn Iterator<Item = &String>| texts.map(|t| t.chars().count()).max().unwrap_or(0) as f64;
    let left = 20.0 + (widest(&mut rows.iter().map(|r| &r.name)) * 6.6).clamp(60.0, 360.0);
    let right = WIDTH - 20.0 - (widest(&mut rows.iter().map(|r| &r.text)) * 6.6).clamp(40.0, 220.0);
    let mut page = Page::new([WIDTH, 100.0], [255; 3], false);
    let top = if series.len() > 1 { legend(&mut page, series, [left, 4.0], WIDTH - left) + 8.0 } else { 10.0 };
    let bottom = top + 10.0 + ROW * rows.len() as f64;
    page.size[1] = bottom + 48.0;
    let ends = rows.iter().flat_map(|row| row.interval.into_iter().flatten().chain(row.value));
    let ends: Vec<f64> = ends.filter(|v| v.is_finite()).collect();
    let widening = if ends.iter().all(|v| *v == 0.0) { [-1.0, 1.0] } else { [0.0, 0.0] };
    let axis = Axis::new(ends.into_iter().chain(widening), [left, right], false);
    for (value, name) in axis.ticks() {
        let x = axis.px(value);
        page.line(vec![[x, top], [x, bottom]], GRID, 1.0);
        page.text([x, bottom + 18.0], name, 12.0, INK, Anchor::Middle);
    }
    page.line(vec![[axis.px(0.0), top], [axis.px(0.0), bottom]], INK, 1.0);
    page.text([(left + right) / 2.0, bottom + 38.0], x_label, 13.0, INK, Anchor::Middle);
    for (i, row) in rows.iter().enumerate() {
        let y = top + 10.0 + ROW * (i as f64 + 0.5);
        page.text([left - 8.0, y + 4.0], &row.name, 12.0, INK, Anchor::End);
        page.text([right + 10.0, y + 4.0], &row.text, 12.0, INK, Anchor::Start);
        let color = color(row.series);
        if let Some([low, high]) = row.interval {
            let [low, high] = [low, high].map(|v| axis.px(v));
            page.line(vec![[low, y], [high, y]], color, 2.0);
            for end in [low, high] {
                page.line(vec![[end, y - 4.0], [end, y + 4.0]], color, 2.0);
            }
        }
        match row.value.filter(|v| v.is_finite()) {
            Some(value) => page.dots(vec![[axis.px(value), y]], 4.2, color, 1.0),
            None => page.text([axis.px(0.0), y + 4.0], "–", 12.0, INK, Anchor::Middle),
        }
    }
    Figure(page)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_has_a_dot_or_a_dash() {
        let row = |value: Option<f64>, interval| IntervalRow {
            name: "ours <7>".into(),
            value,
            interval,
            text: "+1.5".into(),
            series: 0,
        };
        let rows = [row(Some(1.5), Some([-0.5, 3.0])), row(None, None), row(Some(-2.0), None)];
        let text = intervals(&rows, &["one"], "points").svg();
        assert!(text.contains("ours &lt;7&gt;") && text.contains('–') && !text.contains("NaN"), "{text}");
        assert_eq!(text.matches("h.01").count(), 2, "two dots");
        assert!(!intervals(&[], &[], "").svg().contains("NaN"));
        assert!(!intervals(&[row(Some(0.0), Some([0.0, 0.0]))], &["a", "b"], "").svg().contains("NaN"));
    }
}
