//! Pictures and tables.
//!
//! Every picture is first a list of marks on a page, then written as SVG text or as PNG: both show the same.

mod birds_eye;
mod curve;
mod page;
mod png;
mod stroke_font;
mod svg;

pub use birds_eye::{BirdsEyeOptions, Style, birds_eye_png, birds_eye_svg};
pub use curve::{CurveOptions, Series, curve_svg};

/// Why a picture could not be made.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// The picture's area is empty or not a number.
    #[error("area_m {area_m:?} has no inside: it is [x from, x to, y from, y to] in m")]
    Area {
        /// As asked for.
        area_m: [f64; 4],
    },
    /// The picture has no pixel, or far too many.
    #[error("a picture of {width} x {height} pixels: each side must have 16 to 20000; change width_px or area_m")]
    Size {
        /// Pixels.
        width: f64,
        /// Pixels.
        height: f64,
    },
    /// The PNG could not be encoded.
    #[error("the PNG could not be encoded: {0}")]
    Png(String),
}
