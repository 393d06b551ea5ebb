//! Curves on common axes, such as training losses.

use crate::axis::Axis;
use crate::figure::{color, legend_places};
use crate::page::{Anchor, COLORS, GRID, INK, Mark, Page};
use crate::svg::{Theme, svg};

/// Width and height with a legend of one row, px.
const SIZE: [f64; 2] = [860.0, 480.0];
/// Left and right of the plot area, px.
const SIDES: [f64; 2] = [84.0, 836.0];
/// Height of the plot area, and of what is below it, px.
const HEIGHTS: [f64; 2] = [356.0, 60.0];

/// A named curve.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// x and y. A non-finite value (on a logarithmic axis: a non-positive one) is a gap.
    pub points: Vec<[f64; 2]>,
}

/// Title and axis labels.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct CurveOptions {
    /// Title.
    pub title: String,
    /// Label of the horizontal axis.
    pub x_label: String,
    /// Label of the vertical axis.
    pub y_label: String,
    /// Logarithmic vertical axis.
    pub log_y: bool,
}

/// Curves with axes, grid and legend as SVG text.
pub fn curve_svg(series: &[Series], options: &CurveOptions) -> String {
    svg(&curve_page(series, options), Theme::Paper)
}

/// The marks of the curves.
pub(crate) fn curve_page(series: &[Series], options: &CurveOptions) -> Page {
    let drawable = |[x, y]: [f64; 2]| x.is_finite() && y.is_finite() && (!options.log_y || y > 0.0);
    let height = |y: f64| if options.log_y { y.log10() } else { y };
    let shown = || series.iter().flat_map(|s| &s.points).copied().filter(|p| drawable(*p));
    let mut page = Page::new(SIZE, [255; 3], false);
    let top = legend(&mut page, series) + 12.0;
    let bottom = top + HEIGHTS[0];
    page.size[1] = bottom + HEIGHTS[1];
    let x_axis = Axis::new(shown().map(|[x, _]| x), SIDES, false);
    let y_axis = Axis::new(shown().map(|[_, y]| height(y)), [bottom, top], options.log_y);
    axes(&mut page, [&x_axis, &y_axis], [top, bottom], options);
    for (i, s) in series.iter().enumerate() {
        let color = color(i);
        for part in s.points.split(|p| !drawable(*p)).filter(|part| !part.is_empty()) {
            let line: Vec<[f64; 2]> = part.iter().map(|[x, y]| [x_axis.px(*x), y_axis.px(height(*y))]).collect();
            if let [[x, y]] = line[..] {
                page.marks.push(Mark::Squares { corners: vec![[x - 2.0, y - 2.0]], side: 4.0, color });
            }
            strokes(line, i).into_iter().for_each(|stroke| page.line(stroke, color, 1.8));
        }
    }
    page
}

/// Line of the i-th series, dashed if an earlier series has the same colour.
fn strokes(line: Vec<[f64; 2]>, i: usize) -> Vec<Vec<[f64; 2]>> {
    const DASH: f64 = 6.0; // length of dashes and gaps, px
    if i < COLORS.len() {
        return vec![line];
    }
    let mut strokes = Vec::new();
    let mut walked = 0.0; // number of dashes and gaps so far
    for ends in line.windows(2) {
        let ([x, y], [to_x, to_y]) = (ends[0], ends[1]);
        let length = (to_x - x).hypot(to_y - y) / DASH;
        let at = |t: f64| [x + (to_x - x) * t / length, y + (to_y - y) * t / length];
        let mut t = 0.0;
        while t < length {
            let end = (t + 1.0 - (walked + t).fract()).min(length);
            if (walked + 0.5 * (t + end)).rem_euclid(2.0) < 1.0 {
                strokes.push(vec![at(t), at(end)]);
            }
            t = end.max(t + 1e-6);
        }
        walked += length;
    }
    strokes
}

fn axes(page: &mut Page, [x_axis, y_axis]: [&Axis; 2], [top, bottom]: [f64; 2], options: &CurveOptions) {
    let [left, right] = SIDES;
    for (value, name) in x_axis.ticks() {
        let x = x_axis.px(value);
        page.line(vec![[x, top], [x, bottom]], GRID, 1.0);
        page.text([x, bottom + 18.0], name, 12.0, INK, Anchor::Middle);
    }
    for (value, name) in y_axis.ticks() {
        let y = y_axis.px(value);
        page.line(vec![[left, y], [right, y]], GRID, 1.0);
        page.text([left - 8.0, y + 4.0], name, 12.0, INK, Anchor::End);
    }
    page.line(vec![[left, top], [left, bottom], [right, bottom]], INK, 1.2);
    page.text([left, 28.0], &options.title, 16.0, INK, Anchor::Start);
    page.text([(left + right) / 2.0, bottom + HEIGHTS[1] - 16.0], &options.x_label, 13.0, INK, Anchor::Middle);
    page.text_upwards([20.0, (top + bottom) / 2.0], &options.y_label, 13.0);
}

/// Draws names with samples of their lines below the title; returns where the last row ends, px.
fn legend(page: &mut Page, series: &[Series]) -> f64 {
    const SAMPLE: f64 = 22.0; // length of a sample, px
    let names: Vec<&str> = series.iter().map(|s| s.name.as_str()).collect();
    let (places, last) = legend_places(&names, SAMPLE + 6.0, [SIDES[0], 50.0], SIDES[1] - SIDES[0]);
    for (i, (name, [x, y])) in names.into_iter().zip(places).enumerate() {
        let sample = vec![[x, y - 4.0], [x + SAMPLE, y - 4.0]];
        strokes(sample, i).into_iter().for_each(|stroke| page.line(stroke, color(i), 2.5));
        page.text([x + SAMPLE + 6.0, y], name, 12.0, INK, Anchor::Start);
    }
    last + 2.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::page::Rgb;

    #[test]
    fn curves_have_names_and_gaps() {
        let loss = Series {
            name: "loss <total>".into(),
            points: vec![[0.0, 2.0], [1.0, 1.0], [2.0, f64::NAN], [3.0, 0.5], [4.0, 0.25]],
        };
        let single = Series { name: "AP".into(), points: vec![[2.0, 1.5]] };
        for log_y in [false, true] {
            let options =
                CurveOptions { title: "Training".into(), x_label: "step".into(), y_label: "loss".into(), log_y };
            let text = curve_svg(&[loss.clone(), single.clone()], &options);
            for part in ["loss &lt;total&gt;", ">AP<", ">Training<", ">step<", "rotate(-90"] {
                assert!(text.contains(part), "{part}");
            }
            assert!(!text.contains("NaN") && !text.contains("inf"));
            let parts = |color: Rgb| {
                text.matches(&format!("stroke=\"#{:02x}{:02x}{:02x}\"", color[0], color[1], color[2])).count()
            };
            assert_eq!(parts(COLORS[0]), 2 + 1, "two parts around the gap, and the legend");
        }
    }

    #[test]
    fn a_long_legend_lies_above_the_curves() {
        let series: Vec<Series> = (0..9)
            .map(|k| Series { name: format!("simulated with the finding, sensor {k}"), points: vec![[0.0, 1.0]] })
            .collect();
        let [one, all] = [&series[..1], &series[..]].map(|s| curve_page(s, &CurveOptions::default()));
        assert_eq!((one.size, all.size), (SIZE, [SIZE[0], SIZE[1] + 4.0 * 18.0]));
        let highest_mark = |page: &Page| {
            let squares = page.marks.iter().filter_map(|m| match m {
                Mark::Squares { corners, .. } => Some(corners[0][1]),
                _ => None,
            });
            squares.fold(f64::INFINITY, f64::min)
        };
        let lowest_name = all.marks.iter().filter_map(|m| match m {
            Mark::Text { at, text, .. } if text.contains("sensor") => Some(at[1]),
            _ => None,
        });
        assert!(lowest_name.fold(0.0, f64::max) < highest_mark(&all));
    }

    #[test]
    fn nothing_to_draw_is_an_empty_frame() {
        let text = curve_svg(&[], &CurveOptions::default());
        assert!(text.contains("</svg>") && !text.contains("NaN") && !text.contains("inf"));
    }
}
