//! The plot of a finding: what is measured along a covariate, before and after the finding is applied.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Points of a plot.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(from = "CurveFile", into = "CurveFile")]
#[schemars(with = "CurveFile")]
pub struct Curve {
    /// Name and unit along the horizontal axis.
    pub x: String,
    /// Name and unit of what is shown.
    pub y: String,
    /// Whether each sensor has a curve of its own.
    pub by_sensor: bool,
    /// The points.
    pub points: Vec<CurvePoint>,
}

/// A point of a plot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CurvePoint {
    /// Number of the sensor; 0 where one curve serves for all.
    pub sensor: usize,
    /// Covariate.
    pub x: f64,
    /// Measured.
    pub measured: f64,
    /// Simulated as it is.
    pub before: f64,
    /// With the extended simulation.
    pub after: f64,
    /// Standard error of the measured value.
    pub error: f64,
}

/// Points of means over as many of some pairs of a covariate and what is measured there each, in their order, where the
/// simulation has 0.
pub fn means(mut pairs: Vec<[f64; 2]>) -> Vec<CurvePoint> {
    const POINTS: usize = 12;
    pairs.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let point = |chunk: &[[f64; 2]]| {
        let n = chunk.len() as f64;
        let [x, measured] = [0, 1].map(|k: usize| chunk.iter().map(|p| p[k]).sum::<f64>() / n);
        let variance = chunk.iter().map(|p| (p[1] - measured).powi(2)).sum::<f64>() / n;
        CurvePoint { sensor: 0, x, measured, before: 0.0, after: 0.0, error: (variance / n).sqrt() }
    };
    pairs.chunks(pairs.len().div_ceil(POINTS).max(1)).map(point).collect()
}

/// In `diagnosis.json` the curves of sensors lie this far apart along the horizontal axis: sensor `s` at `x + 1000 s`.
const SENSOR_SPACING: f64 = 1000.0;

/// Ends the name of the horizontal axis where each sensor has a curve of its own.
const BY_SENSOR: &str = " (1000 a sensor)";

/// Points of a plot.
#[derive(Serialize, Deserialize, JsonSchema)]
#[schemars(rename = "Curve")]
struct CurveFile {
    /// Name and unit along the horizontal axis.
    x: String,
    /// Name and unit of what is shown.
    y: String,
    /// The points.
    points: Vec<CurvePointFile>,
}

/// A point of a plot.
#[derive(Serialize, Deserialize, JsonSchema)]
#[schemars(rename = "CurvePoint")]
struct CurvePointFile {
    /// Covariate.
    x: f64,
    /// Measured.
    measured: f64,
    /// Simulated as it is.
    before: f64,
    /// With the extended simulation.
    after: f64,
    /// Standard error of the measured value.
    error: f64,
}

impl From<Curve> for CurveFile {
    fn from(curve: Curve) -> Self {
        let Curve { mut x, y, by_sensor, points } = curve;
        if by_sensor {
            x.push_str(BY_SENSOR);
        }
        let written = |p: CurvePoint| CurvePointFile {
            x: if by_sensor { p.x + SENSOR_SPACING * p.sensor as f64 } else { p.x },
            measured: p.measured,
            before: p.before,
            after: p.after,
            error: p.error,
        };
        CurveFile { x, y, points: points.into_iter().map(written).collect() }
    }
}

impl From<CurveFile> for Curve {
    fn from(file: CurveFile) -> Self {
        let stripped = file.x.strip_suffix(BY_SENSOR).map(str::to_owned);
        let by_sensor = stripped.is_some();
        let read = |p: CurvePointFile| {
            let sensor = if by_sensor { (p.x / SENSOR_SPACING).round().max(0.0) } else { 0.0 };
            let x = p.x - SENSOR_SPACING * sensor;
            CurvePoint {
                sensor: sensor as usize,
                x,
                measured: p.measured,
                before: p.before,
                after: p.after,
                error: p.error,
            }
        };
        Curve {
            x: stripped.unwrap_or(file.x),
            y: file.y,
            by_sensor,
            points: file.points.into_iter().map(read).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_of_sensors_are_written_a_thousand_apart() {
        let point = |sensor, x| CurvePoint { sensor, x, measured: 0.9, before: 1.0, after: 0.9, error: 0.1 };
        let curve = Curve {
            x: "azimuth".into(),
            y: "share".into(),
            by_sensor: true,
            points: vec![point(0, -30.0), point(2, 45.0)],
        };
        let value = serde_json::to_value(&curve).unwrap();
        assert_eq!(value["x"], "azimuth (1000 a sensor)");
        assert_eq!((&value["points"][0]["x"], &value["points"][1]["x"]), (&(-30.0).into(), &2045.0.into()));
        assert_eq!(serde_json::from_value::<Curve>(value).unwrap(), curve);
        let one = Curve { points: vec![point(0, 1234.0)], by_sensor: false, ..curve };
        let value = serde_json::to_value(&one).unwrap();
        assert_eq!((&value["x"], &value["points"][0]["x"]), (&"azimuth".into(), &1234.0.into()));
        assert_eq!(serde_json::from_value::<Curve>(value).unwrap(), one);
    }
}
