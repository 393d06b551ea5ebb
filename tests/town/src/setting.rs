//! What a case is made of besides its effects: scene, sensors, frames, columns.

use crate::sensor::Layout;
use data::Stream;
use rand::RngExt;

/// Kind of scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scene {
    /// A town at usual speeds.
    Town,
    /// A town at walking pace to 5 m/s.
    Crawl,
    /// A straight street between smooth walls.
    Parallel,
}

/// Fourth column of a cloud.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Intensity {
    /// No column: x, y, z only.
    None,
    /// Calibrated reflectivity, 0 to 1.
    Reflectivity,
    /// Whole numbers 0 to 255 that fall with range and incidence.
    Counts,
    /// Whole numbers 0 to 65535: a gamma law over a logarithm of the received light.
    Counts16,
    /// Random numbers, 0 to 1.
    Noise,
}

impl Intensity {
    /// All columns.
    pub const ALL: [Intensity; 5] =
        [Intensity::None, Intensity::Reflectivity, Intensity::Counts, Intensity::Counts16, Intensity::Noise];

    /// Name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Intensity::None => "no intensity",
            Intensity::Reflectivity => "reflectivity",
            Intensity::Counts => "counts",
            Intensity::Counts16 => "16-bit counts",
            Intensity::Noise => "noise column",
        }
    }

    /// Values per point.
    pub fn channels(self) -> usize {
        if self == Intensity::None { 3 } else { 4 }
    }

    /// Whether the column depends on the surface.
    pub fn is_of_surface(self) -> bool {
        !matches!(self, Intensity::None | Intensity::Noise)
    }

    /// The value of a point; `None` without the column. `reflectivity` 0 stands for a return without a surface. `gain`
    /// is that of the row.
    pub fn value(
        self,
        reflectivity: f64,
        cos_incidence: f64,
        range_m: f64,
        gain: f64,
        rng: &mut Stream,
    ) -> Option<f32> {
        let speckle = 1.0 + 0.12 * (rng.random::<f64>() + rng.random::<f64>() - 1.0);
        let light = reflectivity * gain * speckle;
        Some(match self {
            Intensity::None => return None,
            Intensity::Noise => rng.random::<f64>() as f32,
            Intensity::Reflectivity => light.min(1.0) as f32,
            Intensity::Counts => {
                let near = 1.0 - (-range_m / 4.0).exp();
                let counts = 3.0 + 900.0 * light * cos_incidence * near / (1.0 + (range_m / 12.0).powf(1.6));
                counts.round().clamp(0.0, 255.0) as f32
            }
            Intensity::Counts16 => {
                let received = light * cos_incidence.powf(0.8) * (12.0 / range_m.max(1.0)).powi(2);
                let level = ((1.0 + 2_000.0 * received).ln() / 8.0).powf(1.0 / 1.4);
                (65_535.0 * level).round().clamp(0.0, 65_535.0) as f32
            }
        })
    }
}

/// Setting of a case.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Setting {
    /// Scene.
    pub scene: Scene,
    /// Sensors.
    pub layout: Layout,
    /// Whether the rig file states rows and columns.
    pub pattern_known: bool,
    /// Fourth column of the clouds, on both sides.
    pub intensity: Intensity,
    /// Scans per second.
    pub rate_hz: f64,
    /// Scans from one frame to the next.
    pub every: usize,
    /// Moving cars.
    pub cars: usize,
    /// Whether the frames have labels.
    pub labels: bool,
    /// Whether parked cars have labels.
    pub parked_labels: bool,
}

impl Setting {
    /// Draws a usual setting: frames that follow each other, or with larger steps between them.
    pub fn draw(rng: &mut Stream) -> Setting {
        let layout = match rng.random_range(0..100u32) {
            0..14 => Layout::Roof(16),
            14..42 => Layout::Roof(32),
            42..62 => Layout::Roof(64),
            62..72 => Layout::Roof(128),
            72..82 => Layout::Rosette,
            _ => Layout::RoofAndGrille,
        };
        let rate_hz = if rng.random_bool(0.5) { 10.0 } else { 20.0 };
        let every = if rng.random_bool(0.35) { 1 } else { rng.random_range(3..9) };
        Setting {
            scene: Scene::Town,
            layout,
            pattern_known: rng.random_bool(0.5),
            intensity: Intensity::ALL[rng.random_range(0..5)],
            rate_hz,
            every,
            cars: rng.random_range(8..15),
            labels: true,
            parked_labels: rng.random_bool(0.6),
        }
    }

    /// Time between frames, s.
    pub fn step_s(&self) -> f64 {
        self.every as f64 / self.rate_hz
    }

    /// In words, for the truth file.
    pub fn describe(&self) -> String {
        let scene = match self.scene {
            Scene::Town => "town",
            Scene::Crawl => "crawl",
            Scene::Parallel => "parallel walls",
        };
        let pattern = if self.pattern_known { "pattern known" } else { "pattern not known" };
        let labels = match (self.labels, self.parked_labels) {
            (false, _) => "no labels",
            (true, false) => "moving cars labelled",
            (true, true) => "all cars labelled",
        };
        format!(
            "{scene}, {}, {pattern}, {}, {} Hz, every {}, {} cars, {labels}",
            self.layout.name(),
            self.intensity.name(),
            self.rate_hz,
            self.every,
            self.cars
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_fall_with_range_and_incidence_and_the_others_as_their_makers_say() {
        let mut rng = data::stream(1, "intensity", 0, 0);
        let mut mean = |column: Intensity, reflectivity: f64, cos: f64, range_m: f64| {
            let values = (0..200).map(|_| column.value(reflectivity, cos, range_m, 1.0, &mut rng).unwrap());
            f64::from(values.sum::<f32>()) / 200.0
        };
        assert!((mean(Intensity::Reflectivity, 0.4, 0.5, 30.0) - 0.4).abs() < 0.01);
        for column in [Intensity::Counts, Intensity::Counts16] {
            let usual = mean(column, 0.1, 1.0, 10.0);
            assert!(mean(column, 0.1, 1.0, 40.0) < 0.9 * usual && mean(column, 0.1, 0.3, 10.0) < 0.95 * usual);
            assert!(mean(column, 0.3, 1.0, 10.0) > 1.1 * usual);
        }
        assert!(mean(Intensity::Counts16, 0.3, 1.0, 5.0) > 255.0);
        assert!((mean(Intensity::Noise, 0.9, 1.0, 5.0) - 0.5).abs() < 0.1);
        assert!(Intensity::None.value(0.5, 1.0, 5.0, 1.0, &mut rng).is_none());
    }
}
