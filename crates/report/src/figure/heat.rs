//! Heat maps of values from 0 to 1.

use super::Figure;
use crate::page::{Anchor, INK, Page};

/// Heat map with the values written on the cells, rows downwards; `None` is a dash.
pub fn heat_map(rows: &[String], columns: &[String], values: &[Vec<Option<f64>>]) -> Figure {
    let longest = |names: &[String]| names.iter().map(|n| n.chars().count()).max().unwrap_or(0) as f64;
    let (left, top) = (20.0 + 7.0 * longest(rows), 24.0 + 5.2 * longest(columns));
    let (wide, high) = (54.0, 28.0);
    let size =
        [left + wide * columns.len() as f64 + 20.0 + 5.0 * longest(columns), top + high * rows.len() as f64 + 12.0];
    let mut page = Page::new(size, [255; 3], false);
    for (j, name) in columns.iter().enumerate() {
        page.text_rising([left + (j as f64 + 0.5) * wide, top - 6.0], name, 12.0);
    }
    for (i, name) in rows.iter().enumerate() {
        let y = top + i as f64 * high;
        page.text([left - 8.0, y + 18.0], name, 12.0, INK, Anchor::End);
        for j in 0..columns.len() {
            let x = left + j as f64 * wide;
            let value = values.get(i).and_then(|row| row.get(j)).copied().flatten();
            if let Some(value) = value {
                let corners = vec![[x, y], [x + wide, y], [x + wide, y + high], [x, y + high]];
                page.shape(corners, [0, 114, 178], 0.0, value.clamp(0.0, 1.0) * 0.75);
            }
            let text = value.map_or("–".into(), |v| format!("{v:.2}"));
            page.text([x + wide / 2.0, y + 18.0], text, 12.0, INK, Anchor::Middle);
        }
    }
    Figure(page)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cell_has_its_number() {
        let names = ["conv1".to_string(), "head".to_string()];
        let text = heat_map(&names, &names, &[vec![Some(1.0), Some(0.25)], vec![None]]).svg();
        assert!(text.contains(">1.00<") && text.contains(">0.25<") && text.matches('–').count() == 2);
    }
}
