//! PNG output. Text is limited to the characters of the stroke font: digits, full stop, m.

use crate::ReportError;
use crate::page::{Anchor, Mark, Page, Rgb};
use crate::stroke_font;
use tiny_skia::{Color, FillRule, LineCap, LineJoin, Paint, Path, PathBuilder, Pixmap, Rect, Stroke, Transform};

/// The page as PNG bytes.
pub(crate) fn png(page: &Page) -> Result<Vec<u8>, ReportError> {
    let [width, height] = page.size;
    let mut pixels = Pixmap::new(width as u32, height as u32).ok_or(ReportError::Size { width, height })?;
    pixels.fill(color(page.background, 1.0));
    for mark in &page.marks {
        draw(&mut pixels, mark, page.rimmed.then_some(page.background));
    }
    pixels.encode_png().map_err(|e| ReportError::Png(e.to_string()))
}

fn draw(pixels: &mut Pixmap, mark: &Mark, rim: Option<Rgb>) {
    match mark {
        Mark::Line { points, closed, color, width, fill } => {
            let Some(path) = path(points, *closed) else { return };
            if *fill > 0.0 {
                pixels.fill_path(&path, &paint(*color, *fill), FillRule::Winding, Transform::identity(), None);
            }
            stroke(pixels, &path, *color, *width);
        }
        Mark::Ring { center, radius, color, width } => {
            if let Some(path) = PathBuilder::from_circle(center[0] as f32, center[1] as f32, *radius as f32) {
                stroke(pixels, &path, *color, *width);
            }
        }
        Mark::Squares { corners, side, color } => {
            let paint = paint(*color, 1.0);
            for [x, y] in corners {
                if let Some(square) = Rect::from_xywh(*x as f32, *y as f32, *side as f32, *side as f32) {
                    pixels.fill_rect(square, &paint, Transform::identity(), None);
                }
            }
        }
        Mark::Dots { centers, radius, color, opacity } => {
            for [x, y] in centers {
                if let Some(path) = PathBuilder::from_circle(*x as f32, *y as f32, *radius as f32) {
                    let paint = paint(*color, *opacity);
                    pixels.fill_path(&path, &paint, FillRule::Winding, Transform::identity(), None);
                }
            }
        }
        Mark::Text { at: [x, y], text, size, color, anchor, .. } => {
            let digits = size * 0.72;
            let back = match anchor {
                Anchor::Start => 0.0,
                Anchor::Middle => stroke_font::width(text, digits) / 2.0,
                Anchor::End => stroke_font::width(text, digits),
            };
            let lines = stroke_font::lines(text, [x - back, *y], digits);
            let paths: Vec<Path> = lines.iter().filter_map(|line| path(line, false)).collect();
            for (color, width) in rim.map(|rim| (rim, size * 0.40)).into_iter().chain([(*color, size * 0.12)]) {
                for path in &paths {
                    stroke(pixels, path, color, width);
                }
            }
        }
    }
}

fn path(points: &[[f64; 2]], closed: bool) -> Option<Path> {
    let mut builder = PathBuilder::new();
    for (i, [x, y]) in points.iter().enumerate() {
        if i == 0 { builder.move_to(*x as f32, *y as f32) } else { builder.line_to(*x as f32, *y as f32) }
    }
    if closed {
        builder.close();
    }
    builder.finish()
}

fn stroke(pixels: &mut Pixmap, path: &Path, color: Rgb, width: f64) {
    let (line_cap, line_join) = (LineCap::Round, LineJoin::Round);
    let stroke = Stroke { width: width as f32, line_cap, line_join, ..Stroke::default() };
    pixels.stroke_path(path, &paint(color, 1.0), &stroke, Transform::identity(), None);
}

fn paint(rgb: Rgb, opacity: f64) -> Paint<'static> {
    let mut paint = Paint { anti_alias: true, ..Paint::default() };
    paint.set_color(color(rgb, opacity));
    paint
}

fn color([r, g, b]: Rgb, opacity: f64) -> Color {
    Color::from_rgba8(r, g, b, (opacity * 255.0).round() as u8)
}
