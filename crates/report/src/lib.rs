//! Figures, tables, the report of a study as one HTML page, and the figures of a diagnosis.
//!
//! Every figure is first a list of drawing primitives, then written as SVG or PNG; both look the same.

mod axis;
mod birds_eye;
mod curve;
mod figure;
mod html;
mod link;
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
pub use link::Link;
pub use pages::comparison::ComparisonReport;
pub use pages::diagnosis::{DiagnosisReport, finding_name, write_finding_pictures};
pub use pages::study::{FrechetRow, ReportFiles, StudyReport, TrainingRun, read_training_run};
pub use scene::{ColoredCloud, Layer, LayerContent, Scene};

pub use tensorboard::write_event_files;

/// Why a figure or report could not be made.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// The area of the figure is empty or not finite.
    #[error("area_m {area_m:?} is empty or not finite: it is [x from, x to, y from, y to] in m")]
    Area {
        /// The requested area.
        area_m: [f64; 4],
    },
    /// The figure has zero pixels, or far too many.
    #[error("a picture of {width} x {height} pixels: each side must have 16 to 20000; change width_px or area_m")]
    Size {
        /// Width, px.
        width: f64,
        /// Height, px.
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

impl data::Located for ReportError {
    fn place(&self) -> data::Place {
        match self {
            ReportError::Data(error) => error.place(),
            _ => data::Place::default(),
        }
    }
}
