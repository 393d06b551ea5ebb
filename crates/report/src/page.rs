//! Drawing primitives of a figure, independent of the output format.

/// Red, green, blue.
pub(crate) type Rgb = [u8; 3];

/// Colour of text and axes.
pub(crate) const INK: Rgb = [70, 78, 88];
/// Colour of grid lines.
pub(crate) const GRID: Rgb = [226, 230, 235];
/// Colour-blind safe palette (Okabe and Ito).
pub(crate) const COLORS: [Rgb; 7] =
    [[0, 114, 178], [213, 94, 0], [0, 158, 115], [204, 121, 167], [230, 159, 0], [86, 180, 233], [110, 110, 110]];

/// A drawing surface: origin at the top left, x to the right, y down, in pixels.
pub(crate) struct Page {
    /// Width and height, px.
    pub size: [f64; 2],
    /// Background colour.
    pub background: Rgb,
    /// Whether text has an outline in the background colour, for legibility on top of other marks.
    pub rimmed: bool,
    /// Marks in drawing order.
    pub marks: Vec<Mark>,
}

/// A drawing primitive.
pub(crate) enum Mark {
    /// A line through points, or a closed polygon.
    Line {
        points: Vec<[f64; 2]>,
        closed: bool,
        color: Rgb,
        width: f64,
        /// Fill opacity, 0 to 1.
        fill: f64,
    },
    /// A circle outline.
    Ring { center: [f64; 2], radius: f64, color: Rgb, width: f64 },
    /// Squares of equal size, by their top left corners.
    Squares { corners: Vec<[f64; 2]>, side: f64, color: Rgb },
    /// Filled circles of equal size, by their centres; `opacity` 0 to 1.
    Dots { centers: Vec<[f64; 2]>, radius: f64, color: Rgb, opacity: f64 },
    /// Text; `at` is the left end, centre or right end of its base line, which is rotated clockwise by `turn_deg`.
    Text { at: [f64; 2], text: String, size: f64, color: Rgb, anchor: Anchor, turn_deg: f64 },
}

/// Horizontal text alignment.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Anchor {
    Start,
    Middle,
    End,
}

impl Page {
    pub fn new(size: [f64; 2], background: Rgb, rimmed: bool) -> Page {
        Page { size, background, rimmed, marks: Vec::new() }
    }

    /// Adds an open line.
    pub fn line(&mut self, points: Vec<[f64; 2]>, color: Rgb, width: f64) {
        self.marks.push(Mark::Line { points, closed: false, color, width, fill: 0.0 });
    }

    /// Adds a closed polygon with fill opacity `fill`.
    pub fn shape(&mut self, points: Vec<[f64; 2]>, color: Rgb, width: f64, fill: f64) {
        self.marks.push(Mark::Line { points, closed: true, color, width, fill });
    }

    /// Adds filled circles.
    pub fn dots(&mut self, centers: Vec<[f64; 2]>, radius: f64, color: Rgb, opacity: f64) {
        if !centers.is_empty() {
            self.marks.push(Mark::Dots { centers, radius, color, opacity });
        }
    }

    /// Adds vertical text, read upwards.
    pub fn text_upwards(&mut self, at: [f64; 2], text: impl Into<String>, size: f64) {
        self.marks.push(Mark::Text {
            at,
            text: text.into(),
            size,
            color: INK,
            anchor: Anchor::Middle,
            turn_deg: -90.0,
        });
    }

    /// Adds slanted text below an axis; `at` is its right end.
    pub fn text_leaning(&mut self, at: [f64; 2], text: impl Into<String>, size: f64) {
        self.marks.push(Mark::Text { at, text: text.into(), size, color: INK, anchor: Anchor::End, turn_deg: -40.0 });
    }

    /// Adds slanted text above a column; `at` is its left end.
    pub fn text_rising(&mut self, at: [f64; 2], text: impl Into<String>, size: f64) {
        self.marks.push(Mark::Text { at, text: text.into(), size, color: INK, anchor: Anchor::Start, turn_deg: -40.0 });
    }

    /// Adds horizontal text.
    pub fn text(&mut self, at: [f64; 2], text: impl Into<String>, size: f64, color: Rgb, anchor: Anchor) {
        self.marks.push(Mark::Text { at, text: text.into(), size, color, anchor, turn_deg: 0.0 });
    }
}
