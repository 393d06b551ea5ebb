//! Bird's eye view of a cloud and its boxes: forward is up, left is left.

use crate::ReportError;
use crate::page::{Anchor, INK, Mark, Page, Rgb};
use crate::{
    png::png,
    svg::{Theme, svg},
};
use data::Cloud;
use geometry::Box3;

const PAPER: Rgb = [252, 252, 250];
const RING: Rgb = [205, 212, 220];
const TRUTH: Rgb = [22, 140, 62];
const HIGH_SCORE: Rgb = [226, 98, 8];
const LOW_SCORE: Rgb = [36, 104, 190];
/// Colours by height, from the ground up.
const HEIGHTS: [Rgb; 6] =
    [[198, 203, 209], [170, 177, 185], [140, 149, 159], [110, 120, 131], [82, 93, 105], [54, 66, 79]];
/// Height range above the lowest points that is mapped to colours, m.
const TALL_M: f32 = 3.0;
/// Detections below this score are drawn in the low-score colour.
const SCORE_LIMIT: f32 = 0.5;

/// Largest ratio of the sides of an area that is chosen from the points and boxes.
const SLIMMEST: f64 = 8.0;
/// Sides of a picture, px.
const SIDES_PX: std::ops::RangeInclusive<f64> = 16.0..=20_000.0;

/// How a box is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Style {
    /// A label: green.
    GroundTruth,
    /// A detection: orange, or blue below a score of 0.5, with the score next to it.
    Detection {
        /// Confidence, 0 to 1.
        score: f32,
    },
}

/// Area and size of the figure.
#[derive(Clone, Debug, PartialEq)]
pub struct BirdsEyeOptions {
    /// `[x from, x to, y from, y to]` in m; `None`: an area with all boxes, nearly all points, and the sensor.
    pub area_m: Option<[f64; 4]>,
    /// Width, px; the height follows from the area.
    pub width_px: u32,
    /// Whether scores are written next to detections.
    pub scores: bool,
}

impl Default for BirdsEyeOptions {
    fn default() -> Self {
        BirdsEyeOptions { area_m: None, width_px: 1200, scores: true }
    }
}

/// The figure as PNG bytes.
pub fn birds_eye_png(
    cloud: &Cloud,
    boxes: &[(Box3, Style)],
    options: &BirdsEyeOptions,
) -> Result<Vec<u8>, ReportError> {
    png(&View::new(cloud, boxes, options)?.page(cloud, boxes, options))
}

/// The figure as SVG text, with a legend.
pub fn birds_eye_svg(cloud: &Cloud, boxes: &[(Box3, Style)], options: &BirdsEyeOptions) -> Result<String, ReportError> {
    let view = View::new(cloud, boxes, options)?;
    let mut page = view.page(cloud, boxes, options);
    legend(&mut page, boxes);
    Ok(svg(&page, Theme::Paper))
}

/// Mapping from metres to pixels.
struct View {
    area_m: [f64; 4],
    px_per_m: f64,
    size: [f64; 2],
}

impl View {
    fn new(cloud: &Cloud, boxes: &[(Box3, Style)], options: &BirdsEyeOptions) -> Result<View, ReportError> {
        let area_m = options.area_m.unwrap_or_else(|| area_of(cloud, boxes));
        let [x0, x1, y0, y1] = area_m;
        if area_m.iter().any(|v| !v.is_finite()) || x0 >= x1 || y0 >= y1 {
            return Err(ReportError::Area { area_m });
        }
        let px_per_m = f64::from(options.width_px) / (y1 - y0);
        let [width, height] = [f64::from(options.width_px), ((x1 - x0) * px_per_m).round()];
        if ![width, height].iter().all(|side| SIDES_PX.contains(side)) {
            return Err(ReportError::Size { width, height });
        }
        Ok(View { area_m, px_per_m, size: [width, height] })
    }

    fn px(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [_, x1, _, y1] = self.area_m;
        [(y1 - y) * self.px_per_m, (x1 - x) * self.px_per_m]
    }

    fn shows(&self, [u, v]: [f64; 2]) -> bool {
        (0.0..self.size[0]).contains(&u) && (0.0..self.size[1]).contains(&v)
    }

    fn page(&self, cloud: &Cloud, boxes: &[(Box3, Style)], options: &BirdsEyeOptions) -> Page {
        let mut page = Page::new(self.size, PAPER, true);
        let every_m = self.rings(&mut page);
        self.points(&mut page, cloud);
        self.sensor(&mut page);
        for truth in [true, false] {
            for (b, style) in boxes.iter().filter(|(_, style)| (*style == Style::GroundTruth) == truth) {
                self.outline(&mut page, b, *style);
            }
        }
        self.ring_names(&mut page, every_m, boxes);
        self.scale(&mut page, every_m / 2.0);
        for (b, style) in boxes.iter().filter(|_| options.scores) {
            self.score(&mut page, b, *style);
        }
        page
    }

    /// Draws range rings around the sensor; returns their spacing, m.
    fn rings(&self, page: &mut Page) -> f64 {
        let [x0, x1, y0, y1] = self.area_m;
        let far_m = [[x0, y0], [x0, y1], [x1, y0], [x1, y1]].iter().map(|[x, y]| x.hypot(*y)).fold(0.0, f64::max);
        let side_m = (x1 - x0).max(y1 - y0);
        let every_m =
            [2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0].into_iter().find(|m| side_m / m < 9.0).unwrap_or(500.0);
        let center = self.px([0.0, 0.0]);
        for i in 1..=(far_m / every_m).floor() as u32 {
            let radius = f64::from(i) * every_m * self.px_per_m;
            page.marks.push(Mark::Ring { center, radius, color: RING, width: 1.0 });
        }
        every_m
    }

    /// Labels each ring with its distance: straight ahead and behind, or slightly offset if a box is in the way.
    fn ring_names(&self, page: &mut Page, every_m: f64, boxes: &[(Box3, Style)]) {
        let [x0, x1, ..] = self.area_m;
        let boxes: Vec<[f64; 2]> = boxes.iter().map(|(b, _)| self.px([b.center[0], b.center[1]])).collect();
        let free = |at: [f64; 2]| boxes.iter().all(|b| (b[0] - at[0]).abs() > 90.0 || (b[1] - at[1]).abs() > 45.0);
        for i in 1..=(x0.abs().max(x1.abs()) / every_m) as i32 {
            let range_m = f64::from(i) * every_m;
            for ahead in [1.0, -1.0] {
                let places = [0.0f64, 0.2, -0.2, 0.4, -0.4].map(|azimuth| {
                    let [u, v] = self.px([ahead * range_m * azimuth.cos(), range_m * azimuth.sin()]);
                    [u, v + 5.0]
                });
                let seen = |[u, v]: [f64; 2]| self.shows([u - 20.0, v - 17.0]) && self.shows([u + 20.0, v]);
                if let Some(at) = places.into_iter().find(|at| seen(*at) && free(*at)) {
                    page.text(at, format!("{range_m} m"), 13.0, INK, Anchor::Middle);
                }
            }
        }
    }

    /// One square per pixel cell, coloured by its highest point, so that the file size is bounded for any cloud.
    fn points(&self, page: &mut Page, cloud: &Cloud) {
        let side = (self.px_per_m / 5.0).floor().clamp(1.0, 3.0);
        let [columns, rows] = self.size.map(|px| (px / side).ceil() as usize);
        let mut highest = vec![f32::NEG_INFINITY; columns * rows];
        for p in cloud.points().filter(|p| p.iter().all(|v| v.is_finite())) {
            let [u, v] = self.px([f64::from(p[0]), f64::from(p[1])]);
            if self.shows([u, v]) {
                let cell = &mut highest[(v / side) as usize * columns + (u / side) as usize];
                *cell = cell.max(p[2]);
            }
        }
        let heights: Vec<f64> = cloud.points().map(|p| f64::from(p[2])).collect();
        let ground = quantiles(heights, [0.05, 0.5])[0] as f32;
        let mut shades: [Vec<[f64; 2]>; HEIGHTS.len()] = Default::default();
        for (i, z) in highest.iter().enumerate().filter(|(_, z)| z.is_finite()) {
            let shade = ((z - ground - 0.25) / TALL_M * HEIGHTS.len() as f32).max(0.0) as usize;
            shades[shade.min(HEIGHTS.len() - 1)].push([(i % columns) as f64 * side, (i / columns) as f64 * side]);
        }
        for (corners, color) in shades.into_iter().zip(HEIGHTS) {
            if !corners.is_empty() {
                page.marks.push(Mark::Squares { corners, side, color });
            }
        }
    }

    /// An arrow head at the sensor position.
    fn sensor(&self, page: &mut Page) {
        let [u, v] = self.px([0.0, 0.0]);
        page.shape(vec![[u, v - 9.0], [u + 6.0, v + 7.0], [u, v + 3.0], [u - 6.0, v + 7.0]], INK, 1.0, 1.0);
    }

    /// Outline of a box's base, and a line from its centre through its front.
    fn outline(&self, page: &mut Page, b: &Box3, style: Style) {
        let (color, width) = match style {
            Style::GroundTruth => (TRUTH, 3.0),
            Style::Detection { .. } => (ink(style), 1.8),
        };
        let ahead = |m: f64| {
            let [x, y, _] = b.from_local([m, 0.0, 0.0]);
            self.px([x, y])
        };
        page.shape(b.bev_corners().map(|corner| self.px(corner)).into(), color, width, 0.10);
        page.line(vec![ahead(0.0), ahead(b.size[0] / 2.0 + 0.8)], color, width);
    }

    /// The score of a detection, to the right of its box.
    fn score(&self, page: &mut Page, b: &Box3, style: Style) {
        let Style::Detection { score } = style else { return };
        let corners = b.bev_corners().map(|corner| self.px(corner));
        let right = corners.iter().map(|c| c[0]).fold(f64::MIN, f64::max);
        let middle = self.px([b.center[0], b.center[1]])[1];
        page.text([right + 5.0, middle + 4.0], format!("{score:.2}"), 13.0, ink(style), Anchor::Start);
    }

    /// A scale bar at the bottom left.
    fn scale(&self, page: &mut Page, length_m: f64) {
        let [left, y, length] = [16.0, self.size[1] - 16.0, length_m * self.px_per_m];
        page.line(vec![[left, y - 5.0], [left, y], [left + length, y], [left + length, y - 5.0]], INK, 2.0);
        page.text([left + length / 2.0, y - 7.0], format!("{length_m} m"), 13.0, INK, Anchor::Middle);
    }
}

fn ink(style: Style) -> Rgb {
    match style {
        Style::GroundTruth => TRUTH,
        Style::Detection { score } if score >= SCORE_LIMIT => HIGH_SCORE,
        Style::Detection { .. } => LOW_SCORE,
    }
}

/// Legend of the colours in use, at the bottom right.
fn legend(page: &mut Page, boxes: &[(Box3, Style)]) {
    let names = [(TRUTH, "ground truth"), (HIGH_SCORE, "detection"), (LOW_SCORE, "detection, score below 0.5")];
    let [width, height] = page.size;
    let mut y = height - 14.0;
    for (color, name) in names.into_iter().rev() {
        if boxes.iter().any(|(_, style)| ink(*style) == color) {
            page.text([width - 14.0, y], name, 13.0, color, Anchor::End);
            y -= 18.0;
        }
    }
}

/// An area with all boxes, nearly all points, and the sensor.
fn area_of(cloud: &Cloud, boxes: &[(Box3, Style)]) -> [f64; 4] {
    const MARGIN_M: f64 = 3.0;
    let axis = |axis: usize| {
        let points = cloud.points().map(|p| f64::from(p[axis])).filter(|v| v.is_finite()).collect();
        let [low, high] = quantiles(points, [0.002, 0.998]);
        let corners = boxes.iter().flat_map(|(b, _)| b.bev_corners()).map(|c| c[axis]).filter(|v| v.is_finite());
        let (low, high) = corners.fold((low.min(0.0), high.max(0.0)), |(a, b), v| (a.min(v), b.max(v)));
        [low - MARGIN_M, high + MARGIN_M]
    };
    let ([x0, x1], [y0, y1]) = (axis(0), axis(1));
    // A narrow strip is widened to both sides.
    let longest = (x1 - x0).max(y1 - y0);
    let widened = |low: f64, high: f64| {
        let by = ((longest / SLIMMEST - (high - low)) / 2.0).max(0.0);
        [low - by, high + by]
    };
    let ([x0, x1], [y0, y1]) = (widened(x0, x1), widened(y0, y1));
    [x0, x1, y0, y1]
}

/// Quantiles at the given fractions; 0 without values.
fn quantiles(mut values: Vec<f64>, shares: [f64; 2]) -> [f64; 2] {
    values.sort_by(f64::total_cmp);
    shares.map(|share| values.get((share * values.len() as f64) as usize).copied().unwrap_or(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiny_skia::Pixmap;

    fn example() -> (Cloud, Vec<(Box3, Style)>) {
        let mut cloud = Cloud::new(3);
        for i in 0..2000 {
            let (range, azimuth) = (5.0 + i as f32 * 0.02, i as f32 * 0.61 % 1.6 - 0.8);
            cloud.values.extend([range * azimuth.cos(), range * azimuth.sin(), -1.7 + (i % 5) as f32 * 0.5]);
        }
        let car = Box3::from_array([20.0, 8.0, -1.0, 4.0, 1.6, 1.5, 0.3]);
        (cloud, vec![(car, Style::GroundTruth), (car, Style::Detection { score: 0.87 })])
    }

    #[test]
    fn left_is_left_and_forward_is_up() {
        let (cloud, boxes) = example();
        let options = BirdsEyeOptions { area_m: Some([0.0, 40.0, -20.0, 20.0]), width_px: 400, scores: false };
        let picture = Pixmap::decode_png(&birds_eye_png(&cloud, &boxes[..1], &options).unwrap()).unwrap();
        assert_eq!((picture.width(), picture.height()), (400, 400));
        let mut greens = Vec::new();
        for v in 0..400 {
            for u in 0..400 {
                let c = picture.pixel(u, v).unwrap();
                if [c.red(), c.green(), c.blue()] == TRUTH {
                    greens.push((f64::from(u), f64::from(v)));
                }
            }
        }
        assert!(greens.len() > 100);
        let mean = |axis: fn(&(f64, f64)) -> f64| greens.iter().map(axis).sum::<f64>() / greens.len() as f64;
        assert!((mean(|g| g.0) - 120.0).abs() < 15.0, "y = 8 m lies 12 m from the left edge");
        assert!((mean(|g| g.1) - 200.0).abs() < 15.0, "x = 20 m lies 20 m from the upper edge");
    }

    #[test]
    fn svg_has_points_boxes_scores_and_a_legend() {
        let (cloud, boxes) = example();
        let text = birds_eye_svg(&cloud, &boxes, &BirdsEyeOptions::default()).unwrap();
        for part in ["ground truth", "0.87", ">20 m<", "<polygon", "<circle", "<path"] {
            assert!(text.contains(part), "{part}");
        }
        assert!(!text.contains("below 0.5") && !text.contains("NaN"));
    }

    #[test]
    fn odd_input_gives_a_picture_or_a_sentence() {
        let empty = Cloud::new(4);
        birds_eye_png(&empty, &[], &BirdsEyeOptions::default()).unwrap();
        let broken = Cloud { values: vec![f32::NAN, 1.0, 2.0, f32::INFINITY, 0.0, 0.0], channels: 3 };
        birds_eye_png(&broken, &[], &BirdsEyeOptions::default()).unwrap();
        let behind = Cloud { values: (0..900).flat_map(|i| [-300.0, (i % 3) as f32, 0.0]).collect(), channels: 3 };
        birds_eye_png(&behind, &[], &BirdsEyeOptions::default()).unwrap();
        let area = |a| BirdsEyeOptions { area_m: Some(a), ..BirdsEyeOptions::default() };
        assert!(matches!(birds_eye_png(&empty, &[], &area([1.0, 1.0, 0.0, 2.0])), Err(ReportError::Area { .. })));
        assert!(matches!(birds_eye_png(&empty, &[], &area([0.0, 1e9, 0.0, 1.0])), Err(ReportError::Size { .. })));
    }
}
