//! Aggregated target points: by distance and data set, and in side, top, front and back view.

use super::{Figure, color};
use crate::page::{Anchor, GRID, INK, Page, Rgb};

/// Points of targets in the box frame.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct TargetCloud {
    /// Title of the panel.
    pub title: String,
    /// Offset from the box centre, m: forward, left, up.
    pub points_m: Vec<[f32; 3]>,
}

/// Viewing direction.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Look {
    /// Right side: forward points right, up points up.
    Side,
    /// Top: forward points right, left points up.
    Top,
    /// Front: left points right, up points up.
    Front,
    /// Back: left points left, up points up.
    Back,
    /// From behind, left and above.
    Slanted,
}

impl Look {
    /// Screen coordinates: right, up and towards the viewer, m.
    fn project(self, [x, y, z]: [f32; 3]) -> [f64; 3] {
        let [x, y, z] = [x, y, z].map(f64::from);
        match self {
            Look::Side => [x, z, -y],
            Look::Top => [x, y, z],
            Look::Front => [y, z, x],
            Look::Back => [-y, z, -x],
            Look::Slanted => {
                let (s, c) = 0.6f64.sin_cos(); // rotation
                let (u, v) = (x * c + y * s, -x * s + y * c);
                let (s, c) = 0.45f64.sin_cos(); // tilt
                [u, z * c + v * s, z * s - v * c]
            }
        }
    }
}

/// Draws one view of a cloud into a panel; `half_m` is the half extent of the panel, horizontal and vertical.
fn draw(
    page: &mut Page,
    cloud: &TargetCloud,
    look: Look,
    [left, top, width, height]: [f64; 4],
    size_m: Option<[f64; 3]>,
    ink: Rgb,
) {
    let size_m = size_m.unwrap_or([5.0, 2.0, 1.5]);
    let [length, wide, high] = size_m;
    let half = match look {
        Look::Side => [length, high],
        Look::Top => [length, wide],
        Look::Front | Look::Back => [wide, high],
        Look::Slanted => [length * 0.95 + wide * 0.3, high + wide * 0.5 + length * 0.14],
    }
    .map(|m| m * 0.62);
    let scale = (width / (2.0 * half[0])).min(height / (2.0 * half[1]));
    let px = |[u, v, _]: [f64; 3]| [left + width / 2.0 + u * scale, top + height / 2.0 - v * scale];
    // Nearer points are darker and drawn on top.
    let mut seen: Vec<[f64; 3]> =
        cloud.points_m.iter().map(|p| look.project(*p)).filter(|p| p.iter().all(|v| v.is_finite())).collect();
    seen.sort_by(|a, b| a[2].total_cmp(&b[2]));
    let layers = seen.chunks(seen.len().div_ceil(4).max(1));
    for (layer, opacity) in layers.zip([0.18, 0.3, 0.45, 0.7]) {
        let inside = layer
            .iter()
            .map(|p| px(*p))
            .filter(|[x, y]| (left..=left + width).contains(x) && (top..=top + height).contains(y));
        page.dots(inside.collect(), 0.8, ink, opacity);
    }
    // The box.
    let corner = |i: usize| {
        let sign = |bit: usize| if i >> bit & 1 == 1 { 0.5 } else { -0.5 };
        px(look.project([0, 1, 2].map(|k| (size_m[k] * sign(k)) as f32)))
    };
    for (a, b) in (0..8).flat_map(|i| [1, 2, 4].map(|bit| (i, i | bit))).filter(|(a, b)| a != b) {
        page.line(vec![corner(a), corner(b)], INK, 0.7);
    }
}

/// One panel per cloud, seen from behind, left and above: a row per data set and a column per range section (`columns`
/// panels per row). `size_m` is the mean box: length, width, height.
pub fn aggregated_targets(clouds: &[TargetCloud], columns: usize, size_m: Option<[f64; 3]>) -> Figure {
    let columns = columns.max(1);
    let (width, height) = (320.0, 190.0);
    let rows = clouds.len().div_ceil(columns);
    let mut page = Page::new([columns as f64 * width, (rows as f64 * (height + 26.0)).max(40.0)], [255; 3], false);
    for (i, cloud) in clouds.iter().enumerate() {
        let (left, top) = ((i % columns) as f64 * width, (i / columns) as f64 * (height + 26.0));
        page.text([left + width / 2.0, top + 16.0], &cloud.title, 12.0, INK, Anchor::Middle);
        draw(
            &mut page,
            cloud,
            Look::Slanted,
            [left + 6.0, top + 22.0, width - 12.0, height],
            size_m,
            color(i / columns),
        );
    }
    Figure(page)
}

/// Side, top, front and back view of one cloud, each at its largest scale that fits, with a scale bar of one metre.
pub fn target_views(cloud: &TargetCloud, size_m: Option<[f64; 3]>) -> Figure {
    let mut page = Page::new([900.0, 560.0], [255; 3], false);
    let panels = [
        (Look::Side, "Side view", [20.0, 30.0, 860.0, 215.0]),
        (Look::Top, "Top view", [20.0, 275.0, 420.0, 265.0]),
        (Look::Front, "Front view", [460.0, 275.0, 200.0, 265.0]),
        (Look::Back, "Back view", [680.0, 275.0, 200.0, 265.0]),
    ];
    for (look, name, area) in panels {
        let [left, top, width, height] = area;
        let frame =
            vec![[left, top], [left + width, top], [left + width, top + height], [left, top + height], [left, top]];
        page.line(frame, GRID, 1.0);
        page.text([left + width / 2.0, top - 8.0], name, 13.0, INK, Anchor::Middle);
        draw(&mut page, cloud, look, [left + 4.0, top + 4.0, width - 8.0, height - 8.0], size_m, color(0));
    }
    page.text([20.0, 18.0], &cloud.title, 13.0, INK, Anchor::Start);
    Figure(page)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_views_agree_about_the_left_front_wheel() {
        let wheel = [1.5, 0.9, -0.4];
        let near = |a: [f64; 3], b: [f64; 3]| (0..3).all(|k| (a[k] - b[k]).abs() < 1e-6);
        assert!(near(Look::Side.project(wheel), [1.5, -0.4, -0.9]));
        assert!(near(Look::Top.project(wheel), [1.5, 0.9, -0.4]));
        assert!(near(Look::Front.project(wheel), [0.9, -0.4, 1.5]));
        assert!(near(Look::Back.project(wheel), [-0.9, -0.4, -1.5]));
        let length = |p: [f64; 3]| p.iter().map(|v| v * v).sum::<f64>();
        assert!((length(Look::Slanted.project(wheel)) - length(wheel.map(f64::from))).abs() < 1e-6, "a rotation");
    }

    #[test]
    fn empty_and_broken_clouds_give_figures() {
        let broken = TargetCloud { title: "long range".into(), points_m: vec![[f32::NAN, 0.0, 0.0]; 3] };
        for figure in
            [aggregated_targets(&[broken.clone(), TargetCloud::default()], 3, None), target_views(&broken, None)]
        {
            assert!(figure.svg().contains("</svg>") && !figure.svg().contains("NaN"));
        }
    }
}
