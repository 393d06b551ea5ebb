//! A page as SVG.

use crate::page::{Anchor, GRID, INK, Mark, Page, Rgb};
use std::fmt::Write;

/// Where the figure is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Theme {
    /// A separate file, always light.
    Paper,
    /// Inside the report, which defines background, ink and grid colours as CSS variables for light and dark mode.
    Report,
}

/// The page as SVG text.
pub(crate) fn svg(page: &Page, theme: Theme) -> String {
    let hex = |color: Rgb| match theme {
        Theme::Report if color == INK => "var(--ink)".into(),
        Theme::Report if color == GRID => "var(--grid)".into(),
        Theme::Report if color == page.background => "var(--plot)".into(),
        _ => hex(color),
    };
    let [width, height] = page.size;
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width:.0}\" height=\"{height:.0}\" viewBox=\"0 0 {width:.0} {height:.0}\" \
         font-family=\"system-ui, sans-serif\">\n<rect width=\"100%\" height=\"100%\" fill=\"{}\"/>\n",
        hex(page.background)
    );
    for mark in &page.marks {
        write_mark(&mut out, mark, page.rimmed.then_some(page.background), &hex)
            .expect("writing to a String does not fail");
        out.push('\n');
    }
    out.push_str("</svg>\n");
    out
}

fn write_mark(out: &mut String, mark: &Mark, rim: Option<Rgb>, hex: &dyn Fn(Rgb) -> String) -> std::fmt::Result {
    match mark {
        Mark::Line { points, closed, color, width, fill } => {
            let (element, hex) = (if *closed { "polygon" } else { "polyline" }, hex(*color));
            write!(out, "<{element} points=\"")?;
            for (i, [x, y]) in points.iter().enumerate() {
                write!(out, "{}{x:.1},{y:.1}", if i > 0 { " " } else { "" })?;
            }
            write!(out, "\" stroke=\"{hex}\" stroke-width=\"{width}\" stroke-linejoin=\"round\"")?;
            if *fill > 0.0 {
                write!(out, " fill=\"{hex}\" fill-opacity=\"{fill}\"/>")
            } else {
                write!(out, " fill=\"none\"/>")
            }
        }
        Mark::Ring { center: [x, y], radius, color, width } => {
            let hex = hex(*color);
            write!(
                out,
                "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius:.1}\" fill=\"none\" stroke=\"{hex}\" stroke-width=\"{width}\"/>"
            )
        }
        Mark::Squares { corners, side, color } => {
            write!(out, "<path fill=\"{}\" d=\"", hex(*color))?;
            for [x, y] in corners {
                write!(out, "M{x} {y}h{side}v{side}h-{side}z")?;
            }
            write!(out, "\"/>")
        }
        Mark::Dots { centers, radius, color, opacity } => {
            // Zero-length lines with round caps: a tenth of the file size of the same number of circles.
            write!(out, "<path fill=\"none\" stroke=\"{}\" stroke-linecap=\"round\" ", hex(*color))?;
            write!(out, "stroke-width=\"{:.1}\" stroke-opacity=\"{opacity}\" d=\"", 2.0 * radius)?;
            for [x, y] in centers {
                write!(out, "M{x:.1} {y:.1}h.01")?;
            }
            write!(out, "\"/>")
        }
        Mark::Text { at: [x, y], text, size, color, anchor, turn_deg } => {
            let turn = match *turn_deg {
                0.0 => String::new(),
                turn => format!(" transform=\"rotate({turn} {x:.1} {y:.1})\""),
            };
            let (anchor, text) = (text_anchor(*anchor), escaped(text));
            let start = format!("<text x=\"{x:.1}\" y=\"{y:.1}\" font-size=\"{size}\" text-anchor=\"{anchor}\"{turn}");
            if let Some(rim) = rim.map(&hex) {
                writeln!(
                    out,
                    "{start} stroke=\"{rim}\" stroke-width=\"4\" fill=\"{rim}\" aria-hidden=\"true\">{text}</text>"
                )?;
            }
            write!(out, "{start} fill=\"{}\">{text}</text>", hex(*color))
        }
    }
}

fn hex([r, g, b]: Rgb) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

fn text_anchor(anchor: Anchor) -> &'static str {
    match anchor {
        Anchor::Start => "start",
        Anchor::Middle => "middle",
        Anchor::End => "end",
    }
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_cannot_leave_its_element() {
        let mut page = Page::new([100.0, 50.0], [255; 3], true);
        page.text([1.0, 2.0], "a < b & c", 10.0, [0; 3], Anchor::Middle);
        let text = svg(&page, Theme::Paper);
        assert!(text.contains(">a &lt; b &amp; c</text>") && text.contains("text-anchor=\"middle\""), "{text}");
        assert_eq!(text.matches("<text").count(), 2, "the rim lies under the text");
    }
}
