//! Figures of a study. Each is built once and written as SVG, as PNG, or into the report.

/// The kinds of figures, a file each; what is public in it is public in the crate.
macro_rules! figures {
    ($($file:ident,)*) => {
        $(mod $file; pub use $file::*;)*
    };
}

figures! {
    bars,
    dots,
    heat,
    intervals,
    marginals,
    scatter,
    target_views,
}

use crate::curve::curve_page;
use crate::page::{Anchor, COLORS, INK, Page, Rgb};
use crate::svg::{Theme, svg};
use crate::{CurveOptions, ReportError, Series};
use resvg::{tiny_skia, usvg};
use std::sync::{Arc, LazyLock};

/// A figure, independent of the output format.
pub struct Figure(pub(crate) Page);

/// Font of PNG figures.
static FONT: &[u8] = include_bytes!("../assets/DejaVuSans-subset.ttf");

static FONTS: LazyLock<Arc<usvg::fontdb::Database>> = LazyLock::new(|| {
    let mut fonts = usvg::fontdb::Database::new();
    fonts.load_font_data(FONT.to_vec());
    Arc::new(fonts)
});

impl Figure {
    /// Curves on common axes.
    pub fn curves(series: &[Series], options: &CurveOptions) -> Self {
        Figure(curve_page(series, options))
    }

    /// The figure as SVG text, light theme.
    pub fn svg(&self) -> String {
        svg(&self.0, Theme::Paper)
    }

    /// SVG for the report, with the report's light or dark theme.
    pub(crate) fn svg_for_report(&self) -> String {
        svg(&self.0, Theme::Report)
    }

    /// The figure as PNG bytes, with `scale` PNG pixels per figure pixel.
    ///
    /// # Errors
    /// A figure that is far too large.
    pub fn png(&self, scale: f32) -> Result<Vec<u8>, ReportError> {
        let failed = |e: String| ReportError::Png(e);
        let options =
            usvg::Options { font_family: "DejaVu Sans".into(), fontdb: FONTS.clone(), ..usvg::Options::default() };
        let text = self.svg().replace("system-ui, sans-serif", "DejaVu Sans");
        let tree = usvg::Tree::from_str(&text, &options).map_err(|e| failed(e.to_string()))?;
        let [width, height] = self.0.size.map(|px| (px as f32 * scale).round());
        let size = ReportError::Size { width: width.into(), height: height.into() };
        if !(1.0..=20_000.0).contains(&width) || !(1.0..=20_000.0).contains(&height) {
            return Err(size);
        }
        let mut pixels = tiny_skia::Pixmap::new(width as u32, height as u32).ok_or(size)?;
        resvg::render(&tree, tiny_skia::Transform::from_scale(scale, scale), &mut pixels.as_mut());
        pixels.encode_png().map_err(|e| failed(e.to_string()))
    }
}

/// Colour of the k-th group.
pub(crate) fn color(k: usize) -> Rgb {
    COLORS[k % COLORS.len()]
}

/// Places of the entries of a legend in rows of at most `width` px from left to right, each a sample of `sample` px and
/// a name of 12 px; `first` is the base line of the first entry. The second value is the base line of the last row.
pub(crate) fn legend_places(names: &[&str], sample: f64, first: [f64; 2], width: f64) -> (Vec<[f64; 2]>, f64) {
    let [left, mut y] = first;
    let mut x = left;
    let mut places = Vec::new();
    for name in names {
        let wide = sample + 14.0 + 7.0 * name.chars().count() as f64;
        if x > left && x + wide > left + width {
            (x, y) = (left, y + 18.0);
        }
        places.push([x, y]);
        x += wide;
    }
    (places, y)
}

/// Draws a legend of names with coloured dots, in rows from left to right; returns its height, px.
pub(crate) fn legend(page: &mut Page, names: &[&str], [left, top]: [f64; 2], width: f64) -> f64 {
    let (places, last) = legend_places(names, 16.0, [left, top + 12.0], width);
    for (k, (name, [x, y])) in names.iter().zip(places).enumerate() {
        page.dots(vec![[x + 6.0, y - 4.0]], 5.0, color(k), 1.0);
        page.text([x + 16.0, y], *name, 12.0, INK, Anchor::Start);
    }
    last - top + 8.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_reaches_the_png() {
        let figure = |title: &str| {
            let options = CurveOptions { title: title.into(), ..CurveOptions::default() };
            Figure::curves(&[], &options)
        };
        let (with, without) = (figure("Zoom 12 m² → α").png(1.0).unwrap(), figure("").png(1.0).unwrap());
        assert_ne!(with, without, "the title is drawn");
        let pixels = tiny_skia::Pixmap::decode_png(&with).unwrap();
        assert_eq!((pixels.width(), pixels.height()), (860, 480));
        assert!(figure("").png(100.0).is_err());
    }

    #[test]
    fn the_report_has_its_own_neutral_colours() {
        let figure = Figure::curves(&[], &CurveOptions::default());
        assert!(figure.svg_for_report().contains("var(--plot)") && !figure.svg().contains("var("));
    }
}
