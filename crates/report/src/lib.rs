//! Pictures, tables, and what is made of them: the report of a study as one HTML page, the pictures of a diagnosis.
//!
//! Every picture is first a list of marks on a page, then written as SVG text or as PNG: both show the same.

mod axis;
mod birds_eye;
mod curve;
mod figure;
mod html;
mod page;
mod pages;
mod png;
mod scene;
mod stroke_font;
mod svg;
mod tensorboard;

pub use birds_eye::{BirdsEyeOptions, Style, birds_eye_png, birds_eye_svg};
pub use curve::{CurveOptions, Series, curve_svg};
pub use figure::*;
pub use pages::diagnosis::{finding_name, write_finding_pictures};
pub use pages::study::{FrechetRow, ReportFiles, StudyReport, TrainingRun, read_training_run};
pub use scene::{Layer, LayerContent, Scene};

pub use tensorboard::write_event_files;

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
    /// The page could not be rendered.
    #[error("the page could not be rendered: {0}")]
    Page(String),
    /// A file could not be read or written.
    #[error(transparent)]
    Data(#[from] data::DataError),
    /// The PNG could not be encoded.
    #[error("the PNG could not be encoded: {0}")]
    Png(String),
}
