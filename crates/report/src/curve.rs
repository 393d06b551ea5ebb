//! Curves over a common axis, as training losses.

use crate::page::{Anchor, Mark, Page, Rgb};
use crate::svg::svg;

const INK: Rgb = [70, 78, 88];
const GRID: Rgb = [226, 230, 235];
/// Colours that people with any colour vision tell apart (Okabe and Ito).
const COLORS: [Rgb; 7] =
    [[0, 114, 178], [213, 94, 0], [0, 158, 115], [204, 121, 167], [230, 159, 0], [86, 180, 233], [60, 60, 60]];
const SIZE: [f64; 2] = [860.0, 480.0];
/// Left, right, top and bottom of the axes on the page, px.
const FRAME: [f64; 4] = [84.0, 836.0, 56.0, 420.0];

/// A curve with its name.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Series {
    /// For the legend.
    pub name: String,
    /// x and y. A value that is not finite (on a logarithmic axis: not positive) is a gap.
    pub points: Vec<[f64; 2]>,
}

/// What stands around the curves.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct CurveOptions {
    /// Above the picture.
    pub title: String,
    /// Below the horizontal axis.
    pub x_label: String,
    /// Left of the vertical axis.
    pub y_label: String,
    /// Logarithmic vertical axis.
    pub log_y: bool,
}

/// Curves with axes, grid and legend as the text of an SVG file.
pub fn curve_svg(series: &[Series], options: &CurveOptions) -> String {
    let drawable = |[x, y]: [f64; 2]| x.is_finite() && y.is_finite() && (!options.log_y || y > 0.0);
    let height = |y: f64| if options.log_y { y.log10() } else { y };
    let shown = || series.iter().flat_map(|s| &s.points).copied().filter(|p| drawable(*p));
    let x_axis = Axis::new(shown().map(|[x, _]| x), [FRAME[0], FRAME[1]], false);
    let y_axis = Axis::new(shown().map(|[_, y]| height(y)), [FRAME[3], FRAME[2]], options.log_y);

    let mut page = Page::new(SIZE, [255; 3], false);
    axes(&mut page, &x_axis, &y_axis, options);
    for (s, color) in series.iter().zip(COLORS.into_iter().cycle()) {
        for part in s.points.split(|p| !drawable(*p)).filter(|part| !part.is_empty()) {
            let line: Vec<[f64; 2]> = part.iter().map(|[x, y]| [x_axis.px(*x), y_axis.px(height(*y))]).collect();
            if let [[x, y]] = line[..] {
                page.marks.push(Mark::Squares { corners: vec![[x - 2.0, y - 2.0]], side: 4.0, color });
            }
            page.line(line, color, 1.8);
        }
    }
    legend(&mut page, series);
    svg(&page)
}

fn axes(page: &mut Page, x_axis: &Axis, y_axis: &Axis, options: &CurveOptions) {
    let [left, right, top, bottom] = FRAME;
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
    page.text([(left + right) / 2.0, SIZE[1] - 16.0], &options.x_label, 13.0, INK, Anchor::Middle);
    let (at, text) = ([20.0, (top + bottom) / 2.0], options.y_label.clone());
    page.marks.push(Mark::Text { at, text, size: 13.0, color: INK, anchor: Anchor::Middle, upright: false });
}

fn legend(page: &mut Page, series: &[Series]) {
    let right = FRAME[1] - 8.0;
    for (i, (s, color)) in series.iter().zip(COLORS.into_iter().cycle()).enumerate() {
        let y = FRAME[2] + 16.0 + 18.0 * i as f64;
        page.line(vec![[right - 22.0, y - 4.0], [right, y - 4.0]], color, 2.5);
        page.text([right - 28.0, y], &s.name, 12.0, INK, Anchor::End);
    }
}

/// One axis: the values it spans, and where its ends lie on the page.
struct Axis {
    low: f64,
    high: f64,
    px: [f64; 2],
    /// Distance of two ticks.
    step: f64,
    /// Values are powers of ten.
    log: bool,
}

impl Axis {
    /// An axis for all values, its ends at ticks where they are near.
    fn new(values: impl Iterator<Item = f64>, px: [f64; 2], log: bool) -> Axis {
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
        let (low, high) = match (low, high) {
            (low, high) if low > high => (0.0, 1.0),
            (low, high) if low == high => (low - 0.5, high + 0.5),
            ends => ends,
        };
        let rough = (high - low) / 6.0;
        let power = 10f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|k| k * power).find(|s| *s >= rough * 0.999).unwrap_or(power);
        let step = if log { step.max(1.0).round() } else { step };
        let vertical = px[0] > px[1];
        let (low, high) =
            if vertical { ((low / step).floor() * step, (high / step).ceil() * step) } else { (low, high) };
        Axis { low, high, px, step, log }
    }

    fn px(&self, value: f64) -> f64 {
        self.px[0] + (value - self.low) / (self.high - self.low) * (self.px[1] - self.px[0])
    }

    /// Value and name of each tick.
    fn ticks(&self) -> Vec<(f64, String)> {
        let (first, last) =
            ((self.low / self.step - 1e-9).ceil() as i64, (self.high / self.step + 1e-9).floor() as i64);
        let digits = (-self.step.log10().floor()).clamp(0.0, 12.0) as usize;
        let name = |value: f64| match (self.log, value.abs()) {
            (true, _) if value.abs() < 5.0 => format!("{}", 10f64.powi(value as i32)),
            (true, _) => format!("1e{value:.0}"),
            (false, size) if size >= 1e5 => format!("{value:.1e}"),
            _ => format!("{value:.digits$}"),
        };
        (first..=last).map(|i| i as f64 * self.step).map(|value| (value, name(value))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tick_names(values: [f64; 2], log: bool) -> Vec<String> {
        let values = values.map(|v| if log { v.log10() } else { v });
        Axis::new(values.into_iter(), [100.0, 0.0], log).ticks().into_iter().map(|(_, name)| name).collect()
    }

    #[test]
    fn ticks_are_round_numbers_around_all_values() {
        assert_eq!(tick_names([0.0, 1.0], false), ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]);
        assert_eq!(tick_names([0.0, 4000.0], false), ["0", "1000", "2000", "3000", "4000"]);
        assert_eq!(tick_names([3.0, 3.0], false).len(), 7);
        assert_eq!(tick_names([0.02, 7.0], true), ["0.01", "0.1", "1", "10"]);
    }

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
    fn nothing_to_draw_is_an_empty_frame() {
        let text = curve_svg(&[], &CurveOptions::default());
        assert!(text.contains("</svg>") && !text.contains("NaN") && !text.contains("inf"));
    }
}
