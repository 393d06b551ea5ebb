//! Horizontal bar charts.

use super::{Figure, color};
use crate::axis::Axis;
use crate::page::{Anchor, GRID, INK, Page};

/// One bar.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Bar {
    /// Label to the left.
    pub name: String,
    /// Length; `None`: unknown, drawn as a dash.
    pub value: Option<f64>,
    /// Text at the end of the bar.
    pub text: String,
    /// Colour index.
    pub series: usize,
}

const WIDTH: f64 = 860.0;

/// Horizontal bars on a common axis that includes zero.
pub fn bars(bars: &[Bar], x_label: &str) -> Figure {
    let longest = bars.iter().map(|b| b.name.chars().count()).max().unwrap_or(0) as f64;
    let (left, right) = (20.0 + (longest * 7.0).clamp(60.0, 320.0), WIDTH - 130.0);
    let bottom = 16.0 + 26.0 * bars.len() as f64;
    let mut page = Page::new([WIDTH, bottom + 52.0], [255; 3], false);
    let values = bars.iter().filter_map(|b| b.value).filter(|v| v.is_finite());
    // If all bars are empty, the axis still starts at zero.
    let ends = if values.clone().all(|v| v == 0.0) { [0.0, 1.0] } else { [0.0, 0.0] };
    let axis = Axis::new(values.chain(ends), [left, right], false);
    for (value, name) in axis.ticks() {
        let x = axis.px(value);
        page.line(vec![[x, 10.0], [x, bottom]], GRID, 1.0);
        page.text([x, bottom + 18.0], name, 12.0, INK, Anchor::Middle);
    }
    page.text([(left + right) / 2.0, bottom + 40.0], x_label, 13.0, INK, Anchor::Middle);
    for (i, bar) in bars.iter().enumerate() {
        let y = 20.0 + 26.0 * i as f64;
        page.text([left - 8.0, y + 11.0], &bar.name, 12.0, INK, Anchor::End);
        let value = bar.value.filter(|v| v.is_finite());
        let end = axis.px(value.unwrap_or(0.0));
        if value.is_some() {
            let zero = axis.px(0.0);
            page.shape(vec![[zero, y], [end, y], [end, y + 16.0], [zero, y + 16.0]], color(bar.series), 0.5, 0.8);
        }
        let text = if value.is_some() { bar.text.as_str() } else { "–" };
        page.text([end.max(axis.px(0.0)) + 6.0, y + 12.0], text, 12.0, INK, Anchor::Start);
    }
    page.line(vec![[axis.px(0.0), 10.0], [axis.px(0.0), bottom]], INK, 1.0);
    Figure(page)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_known_is_a_dash() {
        let bar = |name: &str, value| Bar { name: name.into(), value, text: "12.5".into(), series: 0 };
        let text = bars(&[bar("yaw <b>", Some(12.5)), bar("up", Some(-3.0)), bar("size", None)], "AP").svg();
        assert!(text.contains("yaw &lt;b&gt;") && text.matches("<polygon").count() == 2 && text.contains('–'));
        assert!(!bars(&[], "").svg().contains("NaN"));
    }
}
