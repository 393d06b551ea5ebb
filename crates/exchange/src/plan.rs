//! What the native parameters of a program have to say, gathered from the effects of a list.

use crate::loss::RangeLoss;
use geometry::Pose;
use sensor::effects::SensorPoseError;
use sensor::rig::RowBlock;
use sensor::{Rig, Sensor};

/// The quantities that are expressed by parameters of a program.
pub(crate) struct Plan {
    /// The sensors of the rig.
    pub sensors: Vec<SensorPlan>,
    /// Range noise: mean, standard deviation at range 0, and its growth per metre, m, m and m/m; one for each effect.
    pub noise: Vec<[f64; 3]>,
    /// Standard deviations of the directions, azimuth and elevation, degrees.
    pub jitter_deg: [f64; 2],
    /// Step of the ranges, m; 0 for none.
    pub step_m: f64,
    /// Losses by range.
    pub loss: RangeLoss,
    /// Share of returns lost anywhere, where the program draws a mask.
    pub masked_share: f64,
    /// Full divergence of the beams, rad; 0 for none.
    pub divergence_rad: f64,
    /// Returns per shot.
    pub returns: u32,
    /// Whether shots of a scan have their own times.
    pub shutter: bool,
}

/// A sensor of the rig with what effects changed.
pub(crate) struct SensorPlan {
    /// Name in the rig.
    pub name: String,
    /// `cloud_from_sensor` in the rig, with which points are reported.
    pub nominal: Pose,
    /// The true pose.
    pub mount: Pose,
    /// Horizontal field of view, degrees.
    pub fov_deg: f64,
    /// Scan rate, Hz.
    pub rate_hz: f64,
    /// Least and largest range, m.
    pub limits_m: [f64; 2],
    /// Blocks of rows at equal steps, from the top; empty without a grid.
    pub blocks: Vec<RowBlock>,
    /// Elevation of each row from the top, degrees.
    pub rows_deg: Vec<f64>,
    /// Range offset of each row, m.
    pub row_offsets_m: Vec<f64>,
    /// Shots of a row.
    pub columns: u32,
    /// Hidden directions: azimuth from and to, elevation from and to (degrees), share that is lost.
    pub hidden: Vec<[f64; 5]>,
}

impl Plan {
    /// A plan without effects.
    pub fn of(rig: &Rig) -> Plan {
        Plan {
            sensors: rig.sensors.iter().map(SensorPlan::of).collect(),
            noise: Vec::new(),
            jitter_deg: [0.0; 2],
            step_m: 0.0,
            loss: RangeLoss::default(),
            masked_share: 0.0,
            divergence_rad: 0.0,
            returns: 1,
            shutter: false,
        }
    }

    /// Standard deviation of all noise that does not grow with range, m.
    pub fn constant_noise_m(&self) -> f64 {
        self.noise.iter().map(|[_, base, _]| base * base).sum::<f64>().sqrt()
    }

    /// Mean of all noise, m.
    pub fn offset_m(&self) -> f64 {
        self.noise.iter().map(|[mean, ..]| mean).sum()
    }

    /// Moves the sensor that an error of the mount names to its true pose.
    pub fn misplace(&mut self, error: &SensorPoseError) {
        self.sensors.iter_mut().filter(|s| s.name == error.sensor).for_each(|s| s.mount *= error.error());
    }

    /// The sensors that an effect means by a name; all for an empty name.
    pub fn named(&mut self, name: &str) -> impl Iterator<Item = &mut SensorPlan> {
        self.sensors.iter_mut().filter(move |s| name.is_empty() || s.name == name)
    }
}

impl SensorPlan {
    fn of(sensor: &Sensor) -> SensorPlan {
        let pattern = sensor.pattern.as_ref();
        let rows_deg: Vec<f64> =
            pattern.map_or(Vec::new(), |p| p.row_elevations_rad().into_iter().map(f64::to_degrees).collect());
        SensorPlan {
            name: sensor.name.clone(),
            nominal: sensor.pose(),
            mount: sensor.pose(),
            fov_deg: sensor.horizontal_fov_deg,
            rate_hz: sensor.rate_hz,
            limits_m: [sensor.min_range_m, sensor.max_range_m],
            blocks: pattern.map_or(Vec::new(), |p| p.blocks.clone()),
            row_offsets_m: vec![0.0; rows_deg.len()],
            rows_deg,
            columns: pattern.map_or(0, |p| p.columns),
            hidden: Vec::new(),
        }
    }

    /// Name that is an identifier in the languages of the programs.
    pub fn identifier(&self) -> String {
        let plain: String = self.name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
        if plain.starts_with(|c: char| c.is_ascii_digit()) { format!("sensor_{plain}") } else { plain }
    }

    /// Name as text in an XML attribute.
    pub fn xml_name(&self) -> String {
        xml_text(&self.name)
    }

    /// Points per second of some rows.
    pub fn points_per_second(&self, rows: usize) -> f64 {
        rows as f64 * f64::from(self.columns) * self.rate_hz
    }

    /// Index of the row whose elevation is nearest, if it is within half of the usual step.
    pub fn row_near(&self, elevation_deg: f64) -> Option<usize> {
        let nearest = (0..self.rows_deg.len()).min_by(|a, b| {
            let off = |i: &usize| (self.rows_deg[*i] - elevation_deg).abs();
            off(a).total_cmp(&off(b))
        })?;
        let steps = self.rows_deg.windows(2).map(|w| (w[0] - w[1]).abs()).filter(|s| *s > 0.0);
        let step = steps.fold(f64::INFINITY, f64::min);
        let reach = if step.is_finite() { step / 2.0 } else { 0.5 };
        ((self.rows_deg[nearest] - elevation_deg).abs() <= reach).then_some(nearest)
    }
}

/// Text with the characters that XML reserves replaced. Two hyphens would end a comment.
pub(crate) fn xml_text(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;").replace("--", "- -")
}
