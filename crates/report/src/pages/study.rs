//! The report of a study: one page, with its figures and tables as separate files.

mod analyses;
mod clouds;
mod features;
mod matrix;
mod paired;
mod training;

pub(crate) use training::metrics_lines;
pub use training::{TrainingRun, read_training_run};

use crate::ReportError;
use crate::html::{Item, PageText, Section, ViewTexts, page};
use crate::link::Link;
use crate::scene::Scene;
use data::output::remove_unfinished;
use data::{FolderLock, write_atomic};
use eval::analysis::RunAnalysis;
use eval::distance::Distances;
use eval::features::{CkaTable, Embedding};
use eval::matrix::{Matrix, PairedDifference};
use eval::targets::Targets;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Content of a report; empty parts are omitted.
#[derive(Clone, Debug, Default)]
pub struct StudyReport {
    /// Title.
    pub title: String,
    /// Paragraphs: what the study is, how it is scaled down from the paper, and what was compared.
    pub about: Vec<String>,
    /// Other pages about the same data.
    pub links: Vec<Link>,
    /// The command that reproduces this report.
    pub command: String,
    /// Name and value of each fact: seeds, machine, versions, times.
    pub facts: Vec<(String, String)>,
    /// Warnings to read first, in addition to those of the matrix.
    pub warnings: Vec<String>,
    /// Matrix of train and test sets.
    pub matrix: Option<Matrix>,
    /// Differences of detectors that were trained elsewhere between data sets of the same frames.
    pub paired: Vec<PairedDifference>,
    /// Analyses of single runs, by name.
    pub analyses: Vec<(String, RunAnalysis)>,
    /// t-SNE embeddings of features.
    pub embeddings: Vec<Embedding>,
    /// CKA tables of pairs of networks, by name.
    pub cka: Vec<(String, CkaTable)>,
    /// Fréchet distances of features.
    pub frechet: Vec<FrechetRow>,
    /// Distances between data sets.
    pub distances: Vec<Distances>,
    /// Targets of the data sets.
    pub targets: Vec<Targets>,
    /// Training losses and validation AP.
    pub training: Vec<TrainingRun>,
    /// Clouds with boxes.
    pub scenes: Vec<Scene>,
}

/// Fréchet distance between the features of two train sets.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FrechetRow {
    /// The network.
    pub network: String,
    /// First train set.
    pub a: String,
    /// Second train set.
    pub b: String,
    /// In squared units of the features.
    pub distance: f64,
    /// Noise floor: the distance between two halves of the first set's features. Smaller distances are not
    /// significant.
    pub floor: Option<f64>,
}

/// PNG pixels per figure pixel.
const PNG_SCALE: f32 = 1.5;

/// Files written by [`StudyReport::write`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReportFiles {
    /// Path of the page.
    pub page: PathBuf,
    /// Size of the page, bytes.
    pub page_bytes: usize,
    /// Figures (each as SVG and PNG) and tables.
    pub others: Vec<PathBuf>,
}

impl StudyReport {
    /// Renders the page. It is self-contained and needs no network.
    ///
    /// # Errors
    /// A page that cannot be rendered.
    pub fn html(&self) -> Result<String, ReportError> {
        self.render(&mut self.sections())
    }

    /// Writes `report.html`, `figures/NAME.svg`, `figures/NAME.png` and `tables/NAME.csv` into a folder, and
    /// `matrix.md` and `matrix.tex` if there is a matrix. Waits while another process writes a report there.
    ///
    /// # Errors
    /// A file that cannot be written, or a figure that cannot be drawn.
    pub fn write(&self, folder: &Path) -> Result<ReportFiles, ReportError> {
        let mut sections = self.sections();
        let html = self.render(&mut sections)?;
        let _lock = FolderLock::wait_for(folder, ".reporting")?;
        for inside in ["", "figures", "tables"] {
            remove_unfinished(&folder.join(inside))?;
        }
        let page = folder.join("report.html");
        write_atomic(&page, html.as_bytes())?;
        let mut others = Vec::new();
        let mut write = |name: String, bytes: &[u8]| -> Result<(), ReportError> {
            let path = folder.join(name);
            write_atomic(&path, bytes)?;
            others.push(path);
            Ok(())
        };
        if let Some(matrix) = &self.matrix {
            write("tables/matrix.md".into(), matrix.to_markdown().as_bytes())?;
            write("tables/matrix.tex".into(), matrix.to_latex().as_bytes())?;
        }
        let items = || sections.iter().flat_map(|section| &section.items);
        for item in items().filter(|item| !item.csv.is_empty()) {
            write(format!("tables/{}.csv", item.id), item.csv.as_bytes())?;
        }
        let drawn = |item: &Item| {
            let Some(figure) = &item.figure else { return Ok(None) };
            Ok(Some((figure.svg(), figure.png(PNG_SCALE)?)))
        };
        let drawn: Vec<Result<_, ReportError>> = items().collect::<Vec<_>>().into_par_iter().map(drawn).collect();
        for (item, drawn) in items().zip(drawn) {
            if let Some((svg, png)) = drawn? {
                write(format!("figures/{}.svg", item.id), svg.as_bytes())?;
                write(format!("figures/{}.png", item.id), &png)?;
            }
        }
        Ok(ReportFiles { page, page_bytes: html.len(), others })
    }

    fn render(&self, sections: &mut [Section]) -> Result<String, ReportError> {
        let mut warnings = self.warnings.clone();
        if let Some(matrix) = &self.matrix {
            warnings.extend(matrix.warnings.iter().cloned());
        }
        let footer = match self.command.as_str() {
            "" => "One file: figures, numbers and the view of clouds are inside; nothing is loaded.".to_string(),
            command => format!(
                "Made by: {command}. One file: figures, numbers and the view of clouds are inside; nothing is loaded."
            ),
        };
        let Self { title, about, links, .. } = self;
        page(&PageText { title, about, links, warnings: &warnings, footer: &footer }, sections)
    }

    fn sections(&self) -> Vec<Section> {
        let mut sections = vec![self.facts_section()];
        if let Some(m) = &self.matrix {
            sections.push(matrix::matrix_section(m));
            sections.push(matrix::range_section(m));
        }
        sections.push(paired::section(&self.paired, self.matrix.as_ref()));
        sections.push(analyses::section(&self.analyses));
        sections.push(features::section(self));
        sections.push(clouds::distance_section(&self.distances));
        sections.push(clouds::target_section(&self.targets));
        sections.push(training::section(&self.training));
        sections.push(self.scene_section());
        sections.retain(|section| !section.items.is_empty());
        sections
    }

    fn facts_section(&self) -> Section {
        use crate::html::{TableCell, TableRow};
        let row =
            |(name, value): &(String, String)| TableRow::new(false, [TableCell::new(name), TableCell::new(value)]);
        let rows: Vec<TableRow> = self.facts.iter().map(row).collect();
        let items = match rows.is_empty() {
            true => Vec::new(),
            false => vec![Item::table("study", "What was run.", (&["what", "value"], 2), rows, None)],
        };
        Section { id: "facts", title: "The study", text: Vec::new(), items }
    }

    fn scene_section(&self) -> Section {
        let texts = ViewTexts { list: "Frame", switch: None, without: "; the figures above show the same clouds" };
        let items = match self.scenes.is_empty() {
            true => Vec::new(),
            false => vec![Item::view(
                "scenes",
                "Clouds with boxes. Drag to turn, scroll or pinch to come nearer, drag with the right button or two fingers to move. The \
                 line out of a box shows its front. Positions are rounded to whole centimetres.",
                &self.scenes,
                texts,
            )],
        };
        Section { id: "clouds-3d", title: "Clouds and boxes", text: Vec::new(), items }
    }
}

/// Converts a title to a file name.
pub(crate) fn slug(title: &str) -> String {
    let kept = title.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' });
    let parts: String = kept.collect();
    parts.split('-').filter(|part| !part.is_empty()).collect::<Vec<_>>().join("-")
}

/// Formats a number with the given decimals; a dash for `None`.
pub(crate) fn number(value: Option<f64>, digits: usize) -> String {
    value.filter(|v| v.is_finite()).map_or("–".into(), |v| format!("{v:.digits$}"))
}

/// Formats a number for CSV; empty for `None`.
pub(crate) fn csv_number(value: Option<f64>) -> String {
    value.map_or(String::new(), |v| v.to_string())
}
