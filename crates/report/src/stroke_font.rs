//! Digits drawn as strokes, for figures without a font.

/// Character width including the gap, in digit heights.
const ADVANCE: f64 = 1.0;

/// The strokes of a character on a grid 4 wide and 6 high, y down; empty for an unknown character.
fn strokes(c: char) -> &'static [&'static [[u8; 2]]] {
    match c {
        '0' => &[&[[0, 1], [1, 0], [3, 0], [4, 1], [4, 5], [3, 6], [1, 6], [0, 5], [0, 1]]],
        '1' => &[&[[1, 1], [2, 0], [2, 6]]],
        '2' => &[&[[0, 1], [1, 0], [3, 0], [4, 1], [4, 2], [0, 6], [4, 6]]],
        '3' => &[&[[0, 0], [4, 0], [2, 2], [3, 2], [4, 3], [4, 5], [3, 6], [1, 6], [0, 5]]],
        '4' => &[&[[3, 6], [3, 0], [0, 4], [4, 4]]],
        '5' => &[&[[4, 0], [0, 0], [0, 3], [1, 2], [3, 2], [4, 3], [4, 5], [3, 6], [1, 6], [0, 5]]],
        '6' => &[&[[4, 1], [3, 0], [1, 0], [0, 1], [0, 5], [1, 6], [3, 6], [4, 5], [4, 4], [3, 3], [1, 3], [0, 4]]],
        '7' => &[&[[0, 0], [4, 0], [1, 6]]],
        '8' => &[
            &[[1, 3], [0, 2], [0, 1], [1, 0], [3, 0], [4, 1], [4, 2], [3, 3], [1, 3], [0, 4], [0, 5], [1, 6], [3, 6]],
            &[[3, 6], [4, 5], [4, 4], [3, 3]],
        ],
        '9' => &[&[[4, 2], [3, 3], [1, 3], [0, 2], [0, 1], [1, 0], [3, 0], [4, 1], [4, 5], [3, 6], [1, 6], [0, 5]]],
        '.' => &[&[[1, 5], [1, 6]]],
        'm' => &[&[[0, 6], [0, 2]], &[[0, 3], [1, 2], [2, 3], [2, 6]], &[[2, 3], [3, 2], [4, 3], [4, 6]]],
        _ => &[],
    }
}

/// Width of a text with digits of height `height`.
pub(crate) fn width(text: &str, height: f64) -> f64 {
    text.chars().map(|c| advance(c) * height).sum()
}

fn advance(c: char) -> f64 {
    if matches!(c, '.' | ' ') { ADVANCE / 2.0 } else { ADVANCE }
}

/// The strokes of a text whose base line starts at `at`, with digits of height `height`.
pub(crate) fn lines(text: &str, [x, y]: [f64; 2], height: f64) -> Vec<Vec<[f64; 2]>> {
    let (mut left, mut lines) = (x, Vec::new());
    for c in text.chars() {
        let place = |[u, v]: [u8; 2]| [left + f64::from(u) * height / 6.0, y + (f64::from(v) / 6.0 - 1.0) * height];
        lines.extend(strokes(c).iter().map(|line| line.iter().map(|p| place(*p)).collect()));
        left += advance(c) * height;
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_digit_is_another_shape_inside_its_cell() {
        let shapes: Vec<_> = "0123456789.m".chars().map(|c| lines(&c.to_string(), [0.0, 0.0], 6.0)).collect();
        for (i, shape) in shapes.iter().enumerate() {
            assert!(!shape.is_empty() && !shapes[..i].contains(shape));
            assert!(shape.iter().flatten().all(|[x, y]| (0.0..=4.0).contains(x) && (-6.0..=0.0).contains(y)));
        }
        assert_eq!(width("20 m", 10.0), 35.0);
    }
}
