//! Marks on a page: what a picture is made of, whatever file it becomes.

/// Red, green, blue.
pub(crate) type Rgb = [u8; 3];

/// Text and axes.
pub(crate) const INK: Rgb = [70, 78, 88];
/// Lines behind the data.
pub(crate) const GRID: Rgb = [226, 230, 235];
/// Colours that people with any colour vision tell apart (Okabe and Ito).
pub(crate) const COLORS: [Rgb; 7] =
    [[0, 114, 178], [213, 94, 0], [0, 158, 115], [204, 121, 167], [230, 159, 0], [86, 180, 233], [110, 110, 110]];

/// A page with its origin at the top left, x to the right, y down, in pixels.
pub(crate) struct Page {
    /// Width and height, px.
    pub size: [f64; 2],
    /// What fills it.
    pub background: Rgb,
    /// Whether text has a rim in the background's colour, so that it reads over other marks.
    pub rimmed: bool,
    /// Marks, the first at the bottom.
    pub marks: Vec<Mark>,
}

/// Something drawn.
pub(crate) enum Mark {
    /// A line through points, or a closed shape.
    Line {
        points: Vec<[f64; 2]>,
        closed: bool,
        color: Rgb,
        width: f64,
        /// Opacity of its inside, 0 to 1.
        fill: f64,
    },
    /// A circle's outline.
    Ring { center: [f64; 2], radius: f64, color: Rgb, width: f64 },
    /// Squares of one size, by their top left corners.
    Squares { corners: Vec<[f64; 2]>, side: f64, color: Rgb },
    /// Filled circles of one size, by their centres, `opacity` 0 to 1.
    Dots { centers: Vec<[f64; 2]>, radius: f64, color: Rgb, opacity: f64 },
    /// Text; `at` is the left, middle or right end of its base line, which is turned clockwise by `turn_deg`.
    Text { at: [f64; 2], text: String, size: f64, color: Rgb, anchor: Anchor, turn_deg: f64 },
}

/// Which part of a text its place names.
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

    /// An open line.
    pub fn line(&mut self, points: Vec<[f64; 2]>, color: Rgb, width: f64) {
        self.marks.push(Mark::Line { points, closed: false, color, width, fill: 0.0 });
    }

    /// A closed shape, its inside `fill` opaque.
    pub fn shape(&mut self, points: Vec<[f64; 2]>, color: Rgb, width: f64, fill: f64) {
        self.marks.push(Mark::Line { points, closed: true, color, width, fill });
    }

    /// Filled circles.
    pub fn dots(&mut self, centers: Vec<[f64; 2]>, radius: f64, color: Rgb, opacity: f64) {
        if !centers.is_empty() {
            self.marks.push(Mark::Dots { centers, radius, color, opacity });
        }
    }

    /// Text that runs upwards.
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

    /// Text that falls to the left end of its place, below an axis.
    pub fn text_leaning(&mut self, at: [f64; 2], text: impl Into<String>, size: f64) {
        self.marks.push(Mark::Text { at, text: text.into(), size, color: INK, anchor: Anchor::End, turn_deg: -40.0 });
    }

    /// Text that rises from its place, above a column.
    pub fn text_rising(&mut self, at: [f64; 2], text: impl Into<String>, size: f64) {
        self.marks.push(Mark::Text { at, text: text.into(), size, color: INK, anchor: Anchor::Start, turn_deg: -40.0 });
    }

    /// Upright text.
    pub fn text(&mut self, at: [f64; 2], text: impl Into<String>, size: f64, color: Rgb, anchor: Anchor) {
        self.marks.push(Mark::Text { at, text: text.into(), size, color, anchor, turn_deg: 0.0 });
    }
}
