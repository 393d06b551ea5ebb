//! The report page: sections of figures, tables and 3D views in one self-contained HTML file.

use crate::ReportError;
use crate::figure::Figure;
use crate::link::Link;
use crate::scene::{Scene, scenes_json};
use askama::Template;
use base64::{Engine as _, prelude::BASE64_STANDARD};
use eval::csv_text;

/// One section of the page.
pub(crate) struct Section {
    pub id: &'static str,
    pub title: &'static str,
    pub text: Vec<String>,
    pub items: Vec<Item>,
}

/// A figure, table or 3D view with its caption.
pub(crate) struct Item {
    /// File name stem and anchor.
    pub id: String,
    /// "Figure 3".
    pub label: String,
    pub caption: String,
    /// The underlying data as CSV.
    pub csv: String,
    pub csv_base64: String,
    pub body: Body,
    /// The figure, if it is also written as a separate file.
    pub figure: Option<Figure>,
}

/// Content of an item.
pub(crate) enum Body {
    Figure { svg: String, wide: bool },
    Table { columns: Vec<String>, rows: Vec<TableRow>, text_columns: usize },
    View { scenes_json: String, texts: ViewTexts },
}

/// Texts around a 3D view.
#[derive(Clone, Copy)]
pub(crate) struct ViewTexts {
    /// Before the list of scenes.
    pub list: &'static str,
    /// Beside the switch between the two states of a scene; `None` where scenes have one.
    pub switch: Option<&'static str>,
    /// The end of the sentence that stands there in browsers that cannot draw it.
    pub without: &'static str,
}

/// A table row; `begins` draws a line above it.
pub(crate) struct TableRow {
    pub begins: bool,
    pub cells: Vec<TableCell>,
}

/// A table cell with small text below.
pub(crate) struct TableCell {
    pub text: String,
    pub small: String,
}

impl TableCell {
    pub fn new(text: impl Into<String>) -> Self {
        TableCell { text: text.into(), small: String::new() }
    }

    pub fn with_small(text: impl Into<String>, small: impl Into<String>) -> Self {
        TableCell { text: text.into(), small: small.into() }
    }
}

impl TableRow {
    pub fn new(begins: bool, cells: impl IntoIterator<Item = TableCell>) -> Self {
        TableRow { begins, cells: cells.into_iter().collect() }
    }
}

impl Item {
    /// A figure with its data: columns and lines.
    pub fn figure(
        id: impl Into<String>,
        caption: impl Into<String>,
        figure: Figure,
        numbers: (&[&str], &[Vec<String>]),
    ) -> Self {
        let csv = if numbers.0.is_empty() { String::new() } else { csv_text(numbers.0, numbers.1) };
        let svg = figure.svg_for_report();
        let wide = figure.0.size[0] > 700.0;
        Item { figure: Some(figure), ..Item::new(id.into(), caption.into(), csv, Body::Figure { svg, wide }) }
    }

    /// A table; the first `text_columns` columns are text, the others numbers. `csv`: the table data as CSV; if empty,
    /// it is made from the table.
    pub fn table(
        id: impl Into<String>,
        caption: impl Into<String>,
        (columns, text_columns): (&[&str], usize),
        rows: Vec<TableRow>,
        csv: Option<String>,
    ) -> Self {
        let csv = csv.unwrap_or_else(|| {
            let text = |cell: &TableCell| match cell.small.as_str() {
                "" => cell.text.clone(),
                small => format!("{} {small}", cell.text),
            };
            let lines: Vec<Vec<String>> = rows.iter().map(|row| row.cells.iter().map(text).collect()).collect();
            csv_text(columns, &lines)
        });
        let columns = columns.iter().map(|c| (*c).into()).collect();
        Item::new(id.into(), caption.into(), csv, Body::Table { columns, rows, text_columns })
    }

    /// A 3D view of some scenes.
    pub fn view(id: impl Into<String>, caption: impl Into<String>, scenes: &[Scene], texts: ViewTexts) -> Self {
        Item::new(id.into(), caption.into(), String::new(), Body::View { scenes_json: scenes_json(scenes), texts })
    }

    fn new(id: String, caption: String, csv: String, body: Body) -> Self {
        let csv_base64 = BASE64_STANDARD.encode(&csv);
        Item { id, label: String::new(), caption, csv, csv_base64, body, figure: None }
    }
}

#[derive(Template)]
#[template(path = "report.html")]
struct PageTemplate<'a> {
    title: &'a str,
    about: &'a [String],
    links: &'a [Link],
    warnings: &'a [String],
    sections: &'a [Section],
    footer: &'a str,
    style: &'static str,
    viewer: bool,
    viewer_script: &'static str,
}

/// Title, introduction and facts of the page.
pub(crate) struct PageText<'a> {
    pub title: &'a str,
    pub about: &'a [String],
    pub links: &'a [Link],
    pub warnings: &'a [String],
    pub footer: &'a str,
}

/// Numbers the figures and tables, and renders the page.
pub(crate) fn page(text: &PageText, sections: &mut [Section]) -> Result<String, ReportError> {
    let (mut figures, mut tables, mut viewer) = (0, 0, false);
    for item in sections.iter_mut().flat_map(|section| &mut section.items) {
        item.label = match item.body {
            Body::Table { .. } => {
                tables += 1;
                format!("Table {tables}")
            }
            _ => {
                figures += 1;
                viewer |= matches!(item.body, Body::View { .. });
                format!("Figure {figures}")
            }
        };
    }
    let template = PageTemplate {
        title: text.title,
        about: text.about,
        links: text.links,
        warnings: text.warnings,
        sections,
        footer: text.footer,
        style: include_str!("../templates/report.css"),
        viewer,
        viewer_script: include_str!("../assets/viewer.min.js"),
    };
    template.render().map_err(|e| ReportError::Page(e.to_string()))
}
