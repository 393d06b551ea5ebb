//! The centre line of a closed track: a table of points, and a smooth curve through them.

use data::DataError;
use data::limits::{MOST_TEXT_BYTES, read_file};
use serde::Deserialize;
use std::f64::consts::TAU;
use std::fmt::Write as _;
use std::path::Path;

/// Length of a lap, m. The Nordschleife has 21 km.
pub const MOST_LAP_M: f64 = 100_000.0;

/// A point of the table, in the world frame: x east, y north, z up, m.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CentrePoint {
    /// East, m.
    pub x_m: f64,
    /// North, m.
    pub y_m: f64,
    /// Up, m; 0 if the table has no such column.
    #[serde(default)]
    pub z_m: f64,
    /// Cross slope, degrees; positive if the right side is higher, as in left turns.
    #[serde(default)]
    pub bank_deg: f64,
    /// Distance to the left edge, m.
    pub width_left_m: f64,
    /// Distance to the right edge, m.
    pub width_right_m: f64,
}

impl CentrePoint {
    fn values(&self) -> [f64; 6] {
        [self.x_m, self.y_m, self.z_m, self.bank_deg, self.width_left_m, self.width_right_m]
    }
}

/// A closed centre line. Positions are given by the arc length from its first point, m, modulo the lap.
#[derive(Clone, Debug, PartialEq)]
pub struct CentreLine {
    points: Vec<CentrePoint>,
    /// Arc length at each point, and the lap length at the end, m.
    way_m: Vec<f64>,
}

/// Geometry of the track at one position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Station {
    /// Centre, m.
    pub position: [f64; 3],
    /// Direction of travel, rad, counter-clockwise from +x.
    pub heading_rad: f64,
    /// Longitudinal slope, m per m.
    pub slope: f64,
    /// Cross slope, rad; positive if the right side is higher.
    pub bank_rad: f64,
    /// Distance to the left edge, m.
    pub width_left_m: f64,
    /// Distance to the right edge, m.
    pub width_right_m: f64,
}

impl CentreLine {
    /// A closed line through these points; `wrong` makes the error of a point (counted from 0) or of the whole line.
    fn new(
        points: Vec<CentrePoint>,
        wrong: impl Fn(Option<usize>, String) -> DataError,
    ) -> Result<CentreLine, DataError> {
        if points.len() < 8 {
            return Err(wrong(None, format!("has {} points; a closed track needs 8 at least", points.len())));
        }
        let mut way_m = vec![0.0];
        for (i, p) in points.iter().enumerate() {
            if p.values().iter().any(|v| !v.is_finite()) {
                return Err(wrong(Some(i), "a value is not finite".into()));
            }
            if p.bank_deg.abs() > 45.0 {
                return Err(wrong(Some(i), format!("bank_deg = {} is steeper than 45", p.bank_deg)));
            }
            if !(1.0..=50.0).contains(&p.width_left_m) || !(1.0..=50.0).contains(&p.width_right_m) {
                return Err(wrong(Some(i), "a width is not between 1 and 50 m".into()));
            }
            let next = &points[(i + 1) % points.len()];
            let step = (next.x_m - p.x_m).hypot(next.y_m - p.y_m).hypot(next.z_m - p.z_m);
            if step < 0.01 {
                return Err(wrong(
                    Some(i),
                    "the next point is at the same place; the last point must not repeat the first".into(),
                ));
            }
            way_m.push(way_m[i] + step);
        }
        let lap = way_m[points.len()];
        if lap > MOST_LAP_M {
            return Err(wrong(None, format!("is {lap:.0} m long; at most {MOST_LAP_M} m are supported")));
        }
        let closing = lap - way_m[points.len() - 1];
        if closing > 20.0 * lap / points.len() as f64 {
            return Err(wrong(None, format!("is not closed: {closing:.1} m lie between its last and its first point")));
        }
        Ok(CentreLine { points, way_m })
    }

    /// Reads a CSV with the columns `x_m, y_m, z_m, bank_deg, width_left_m, width_right_m`; `z_m` and `bank_deg` are
    /// optional.
    pub fn read(path: &Path) -> Result<CentreLine, DataError> {
        let bytes = read_file(path, MOST_TEXT_BYTES)?;
        let mut reader =
            csv::ReaderBuilder::new().trim(csv::Trim::All).comment(Some(b'#')).from_reader(bytes.as_slice());
        let headers = reader.headers().map_err(|e| DataError::line(path, 1, e.to_string()))?.clone();
        let (mut points, mut lines) = (Vec::new(), Vec::new());
        for record in reader.records() {
            let at = |e: &csv::Error| e.position().map_or(1, |p| p.line() as usize);
            let record = record.map_err(|e| DataError::line(path, at(&e), e.to_string()))?;
            let line = record.position().map_or(1, |p| p.line() as usize);
            let point = record.deserialize(Some(&headers)).map_err(|e| DataError::line(path, line, e.to_string()))?;
            points.push(point);
            lines.push(line);
        }
        CentreLine::new(points, |point, message| match point {
            Some(i) => DataError::line(path, lines[i], message),
            None => DataError::file(path, message),
        })
    }

    /// A line through generated points.
    pub(crate) fn from_points(points: Vec<CentrePoint>) -> CentreLine {
        let wrong = |_, message| DataError::file(Path::new("built-in track"), message);
        CentreLine::new(points, wrong).expect("a track made by the program is a track")
    }

    /// The table as CSV, rounded to 1 mm.
    pub fn to_csv(&self) -> String {
        let mut text = String::from("x_m,y_m,z_m,bank_deg,width_left_m,width_right_m\n");
        for p in &self.points {
            let [x, y, z, bank, left, right] = p.values();
            let _ = writeln!(text, "{x:.3},{y:.3},{z:.3},{bank:.3},{left:.3},{right:.3}");
        }
        text
    }

    /// Length of a lap, m.
    pub fn length_m(&self) -> f64 {
        self.way_m[self.points.len()]
    }

    /// The points of the table.
    pub fn points(&self) -> &[CentrePoint] {
        &self.points
    }

    /// The track at arc length `way_m`.
    pub fn at(&self, way_m: f64) -> Station {
        let n = self.points.len();
        let way = way_m.rem_euclid(self.length_m());
        let i = self.way_m[1..n].partition_point(|w| *w <= way);
        let step = self.way_m[i + 1] - self.way_m[i];
        let t = (way - self.way_m[i]) / step;
        let value = |k: usize| self.points[k % n].values();
        let span = |k: usize| self.way_m[k % n + 1] - self.way_m[k % n];
        let (p0, p1) = (value(i), value(i + 1));
        let (before, after) = (value(i + n - 1), value(i + 2));
        let (h0, h2) = (span(i + n - 1), span(i + 1));
        // Cubic Hermite curve; the tangent at a point is that of the parabola through it and its neighbours.
        let (mut v, mut slope) = ([0.0; 6], [0.0; 6]);
        for k in 0..6 {
            let (d0, d1, d2) = ((p0[k] - before[k]) / h0, (p1[k] - p0[k]) / step, (after[k] - p1[k]) / h2);
            let m0 = (d0 * step + d1 * h0) / (h0 + step) * step;
            let m1 = (d1 * h2 + d2 * step) / (step + h2) * step;
            let (a, b) = (2.0 * p0[k] - 2.0 * p1[k] + m0 + m1, 3.0 * (p1[k] - p0[k]) - 2.0 * m0 - m1);
            v[k] = ((a * t + b) * t + m0) * t + p0[k];
            slope[k] = ((3.0 * a * t + 2.0 * b) * t + m0) / step;
        }
        let along = slope[0].hypot(slope[1]);
        Station {
            position: [v[0], v[1], v[2]],
            heading_rad: slope[1].atan2(slope[0]),
            slope: slope[2] / along,
            bank_rad: v[3].to_radians(),
            width_left_m: v[4],
            width_right_m: v[5],
        }
    }

    /// Arc length of the nearest point of the centre line, and the lateral offset to its left, m. Exact if the offset
    /// is smaller than the radius of curvature.
    pub fn project(&self, [x, y]: [f64; 2]) -> (f64, f64) {
        let distance = |p: &CentrePoint| (p.x_m - x).hypot(p.y_m - y);
        let nearest = (0..self.points.len())
            .min_by(|a, b| distance(&self.points[*a]).total_cmp(&distance(&self.points[*b])))
            .expect("a line has points");
        let mut way = self.way_m[nearest];
        for _ in 0..20 {
            let station = self.at(way);
            let (s, c) = station.heading_rad.sin_cos();
            let ahead = (x - station.position[0]) * c + (y - station.position[1]) * s;
            way += ahead;
            if ahead.abs() < 1e-6 {
                break;
            }
        }
        let station = self.at(way);
        let (s, c) = station.heading_rad.sin_cos();
        let left = -(x - station.position[0]) * s + (y - station.position[1]) * c;
        (way.rem_euclid(self.length_m()), left)
    }

    /// Whether the line makes one left turn per lap.
    pub fn turns_left(&self) -> bool {
        let n = self.points.len();
        let heading = |i: usize| {
            let (a, b) = (&self.points[i % n], &self.points[(i + 1) % n]);
            (b.y_m - a.y_m).atan2(b.x_m - a.x_m)
        };
        let turned: f64 = (0..n).map(|i| geometry::limit_period(heading(i + 1) - heading(i), 0.5, TAU)).sum();
        turned > 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn circle(radius: f64, n: usize) -> CentreLine {
        let point = |i: usize| {
            let (s, c) = (TAU * i as f64 / n as f64).sin_cos();
            CentrePoint {
                x_m: radius * c,
                y_m: radius * s,
                z_m: 1.0,
                bank_deg: 10.0,
                width_left_m: 6.0,
                width_right_m: 7.0,
            }
        };
        CentreLine::from_points((0..n).map(point).collect())
    }

    #[test]
    fn a_circle_is_round() {
        let line = circle(100.0, 120);
        assert!((line.length_m() - TAU * 100.0).abs() < 0.2 && line.turns_left());
        for i in 0..1000 {
            let way = f64::from(i) * 0.7;
            let station = line.at(way);
            let [x, y, z] = station.position;
            assert!((x.hypot(y) - 100.0).abs() < 2e-3 && (z - 1.0).abs() < 1e-12);
            let want = y.atan2(x) + TAU / 4.0;
            assert!(geometry::limit_period(station.heading_rad - want, 0.5, TAU).abs() < 1e-3);
            let (back, left) = line.project([x * 0.97, y * 0.97]);
            assert!((left - 3.0).abs() < 1e-2 && (back - way.rem_euclid(line.length_m())).abs() < 0.05);
        }
        let (a, b) = (line.at(line.length_m() - 1e-9), line.at(0.0));
        assert!((0..3).all(|k| (a.position[k] - b.position[k]).abs() < 1e-6));
    }

    #[test]
    fn csv_and_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("t.csv");
        let line = circle(50.0, 40);
        std::fs::write(&path, line.to_csv()).unwrap();
        let read = CentreLine::read(&path).unwrap();
        assert!((read.length_m() - line.length_m()).abs() < 0.05);
        assert_eq!(read.to_csv(), line.to_csv());
    }

    #[test]
    fn bad_tables_are_refused_by_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("t.csv");
        let good = circle(50.0, 12).to_csv();
        let line = |i: usize| good.lines().nth(i).unwrap().to_owned();
        let cases = [
            (good.lines().take(5).collect::<Vec<_>>().join("\n"), "t.csv: has 4 points"),
            (good.replace(&line(3), "a,b,c,d,e,f"), "t.csv:4"),
            (good.replace(&line(3), "1,2,nan,0,6,6"), "t.csv:4: a value is not finite"),
            (good.replace(&line(3), &line(2)), "t.csv:3: the next point is at the same place"),
            (good.replace("7.000", "0.1"), "t.csv:2: a width is not between"),
            (good.replace("10.000", "80"), "t.csv:2: bank_deg = 80"),
            (good.replace("bank_deg", "banking"), "unknown field `banking`"),
        ];
        for (text, want) in cases {
            std::fs::write(&path, text).unwrap();
            let error = CentreLine::read(&path).unwrap_err().to_string();
            assert!(error.contains(want), "{error}, not {want}");
        }
    }
}
