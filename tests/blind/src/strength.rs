//! Strength of hidden effects: what an oracle that knows all forms would see of them, from some of the shots.

use crate::detection::Incidence;
use crate::effect::{Clock, Effect};
use crate::scan::Side;
use crate::solid::{Hit, Material};
use crate::world::REACH_M;
use nalgebra::{Isometry3, Point3, Vector3};
use score::{Counts, FrameEvidence, FrameStds, Oracle, Row, Verdicts, bernoulli_divergence};

/// Shots of a frame that are looked at, at least, if it has as many.
const SHOTS: usize = 2_500;

/// Smallest cosine of incidence of a shot that counts for mean ranges.
const LEAST_COS: f64 = 0.05;

/// Standard deviations of walls (along their normals) and of the faces of cars, m.
const SURFACE_STD_M: [f64; 2] = [0.0115, 0.008];

/// Resolution of a range in which no rounding is seen, m.
const RESOLUTION_M: f64 = 1.5e-3;

/// Probability that a shot meets something else than in the model; at the edges where pixels mix it is a half.
const SURPRISE: [f64; 2] = [0.003, 0.5];

/// A shot whose surface is known.
pub struct Observation<'a> {
    /// Incidence as the losses see it.
    pub at: Incidence<'a>,
    /// Begin and direction of the shot in the ego frame.
    pub origin: Point3<f64>,
    /// Direction in the ego frame.
    pub ray: Vector3<f64>,
    /// Row of the sensor.
    pub row: usize,
    /// Time after the middle of the scan as a fraction of the scan.
    pub phase: f64,
    /// Received energy: ln(rho cos / R^2).
    pub energy: f64,
    /// Displacement by mixed pixels, m.
    pub mixed_m: f64,
}

/// Motion of the ego vehicle in its own frame: m/s and rad/s.
pub struct Motion {
    velocity: Vector3<f64>,
    turn: Vector3<f64>,
}

impl Side<'_> {
    /// One of so many shots of a frame is looked at.
    pub fn looks_at_every(&self) -> usize {
        (self.shots() / SHOTS).max(1)
    }

    fn shots(&self) -> usize {
        self.rig.iter().map(|m| m.rows_rad.len() * m.columns).sum()
    }

    /// Motion of the ego vehicle, or velocity of another car in the ego frame.
    pub fn motion(&self, driver: usize, t: f64) -> Motion {
        let h = 1e-3;
        let [before, after] = [t - h, t + h].map(|t| self.world.pose(driver, t));
        let ego = self.world.pose(0, t);
        let velocity =
            ego.inverse_transform_vector(&((after.translation.vector - before.translation.vector) / (2.0 * h)));
        let turn = (before.rotation.inverse() * after.rotation).scaled_axis() / (2.0 * h);
        Motion { velocity, turn }
    }

    /// Displacement of a shot's range by an effect, m.
    fn shift_m(&self, effect: &Effect, o: &Observation, t: f64) -> f64 {
        let (hit, ray) = (o.at.hit, &o.ray);
        let along = hit.normal.dot(ray);
        // The begin of the shot and its direction are elsewhere than reported.
        let moved =
            |origin: Vector3<f64>, turned: Vector3<f64>| -hit.normal.dot(&(origin + turned * hit.range_m)) / along;
        match effect {
            Effect::RangeBias { offset_m, scale } => offset_m + scale * hit.range_m,
            Effect::AzimuthRipple { amplitude_m, waves } => amplitude_m * (waves * o.at.angles[0]).sin(),
            Effect::BeamRangeOffset { .. } => self.beams[o.at.sensor][o.row][0],
            Effect::BeamElevationOffset { .. } => {
                let up = (Vector3::z() - ray * ray.z).normalize();
                moved(Vector3::zeros(), up * self.beams[o.at.sensor][o.row][1])
            }
            Effect::SensorExtrinsics { sensor, turn_rad, shift_m } if *sensor == o.at.sensor => {
                let pose = o.at.mount.pose();
                let turn = pose.rotation * Vector3::from(*turn_rad);
                moved(pose.rotation * Vector3::from(*shift_m), turn.cross(ray))
            }
            Effect::PitchRoll { pitch_rad, roll_rad } => {
                let turn = Vector3::new(*roll_rad, *pitch_rad, 0.0);
                moved(turn.cross(&o.origin.coords), turn.cross(ray))
            }
            Effect::RollingShutter { scan_s } => {
                let (late, ego) = (o.phase * scan_s, self.motion(0, t));
                let origin = (ego.velocity + ego.turn.cross(&o.origin.coords)) * late;
                let car = hit.car.map_or_else(Vector3::zeros, |car| self.motion(car, t).velocity * late);
                moved(origin - car, ego.turn.cross(ray) * late)
            }
            Effect::WrongShape { length, height } => hit.car.map_or(0.0, |car| {
                let pose = self.world.pose(0, t).inverse() * self.world.pose(car, t);
                let size = self.world.shape(car).size_m;
                let local = pose.inverse() * (o.origin + ray * hit.range_m);
                let grown = Vector3::new(length * local.x, 0.0, height * (local.z + size[2] / 2.0));
                hit.normal.dot(&(pose.rotation * grown)) / along
            }),
            _ => 0.0,
        }
    }

    /// Variance of a shot's range by an effect, m2.
    fn variance_m2(&self, effect: &Effect, o: &Observation) -> f64 {
        let (range, cos) = (o.at.hit.range_m, o.at.cos.max(LEAST_COS));
        match effect {
            Effect::RangeNoise { sigma_m, growth_per_m } => (sigma_m * (1.0 + growth_per_m * range)).powi(2),
            Effect::AngularJitter { sigma_rad } => (sigma_rad * range).powi(2) * (1.0 / (cos * cos) - 1.0),
            Effect::SidedNoise { sigma_m } => {
                (sigma_m * (0.5 + o.at.angles[0] / o.at.mount.fov_rad).clamp(0.0, 1.0)).powi(2)
            }
            _ => 0.0,
        }
    }

    /// Adds a shot that met a surface.
    pub fn observe(&self, o: &Observation, t: f64, evidence: &mut FrameEvidence) {
        let kept: Vec<f64> = self.effects.iter().map(|effect| self.expected_kept(effect, o)).collect();
        let usual = if o.energy < self.nuisances.weakest { 0.0 } else { 1.0 - self.nuisances.lost };
        let all = usual * kept.iter().product::<f64>();
        let each = self.looks_at_every() as f64;
        evidence.returns += each * all;
        let shifts: Vec<f64> = self.effects.iter().map(|effect| self.shift_m(effect, o, t)).collect();
        let variances: Vec<f64> = self.effects.iter().map(|effect| self.variance_m2(effect, o)).collect();
        let mut losses = vec![0.0; kept.len()];
        for (k, effect) in self.effects.iter().enumerate() {
            let without = usual * kept.iter().enumerate().filter(|(i, _)| *i != k).map(|(_, p)| p).product::<f64>();
            losses[k] = all - without;
            let c = &mut evidence.counts[k];
            c.divergence += each * bernoulli_divergence(all, without);
            c.touched += each * (without - all);
            let moved = match effect {
                Effect::MixedPixels { .. } => o.mixed_m.abs() > 0.05,
                Effect::MissingObject { .. } => o.at.hit.material == Material::Container,
                Effect::EgoOcclusion { .. } => o.at.hit.material == Material::Carbon && o.at.hit.car.is_none(),
                _ => false,
            };
            if moved {
                let at_edge = usize::from(matches!(effect, Effect::MixedPixels { .. }));
                c.moved += each;
                c.moved_usual += each * SURPRISE[at_edge];
                c.touched += each * all;
            }
            if let Effect::Quantisation { step_m } = effect {
                c.other += each * all * 2.0 * (step_m / RESOLUTION_M).max(1.1).ln();
            }
        }
        let along = o.at.hit.normal.dot(&o.ray);
        if along.abs() < LEAST_COS || all == 0.0 {
            return;
        }
        let noise_m2 = self.nuisances.noise_m.powi(2);
        let total = 2.0 * noise_m2 + variances.iter().sum::<f64>();
        let shift = -o.at.hit.normal / along;
        let turn = -o.ray.cross(&o.at.hit.normal) * (o.at.hit.range_m / along);
        evidence.means.push(Row {
            columns: shifts,
            frame: vec![shift.x, shift.y, shift.z, turn.x, turn.y, turn.z],
            patch: patch(o.at.hit).map(|(patch, std)| (patch, 1.0 / along, std)),
            weight: each * all / total,
        });
        let weight = 0.5 * each * all / (total * total);
        evidence.variances.push(Row { columns: variances, frame: vec![], patch: None, weight });
        let p = all.clamp(2e-3, 1.0 - 2e-3);
        evidence.losses.push(Row { columns: losses, frame: vec![], patch: None, weight: each / (p * (1.0 - p)) });
    }

    fn expected_kept(&self, effect: &Effect, o: &Observation) -> f64 {
        match effect {
            // The speckle is normal; the logistic function with this slope is within 0.01 of its integral.
            Effect::SignalDropout { half_at, speckle } => 1.0 / (1.0 + (-1.702 * (o.energy - half_at) / speckle).exp()),
            other => other.kept(&o.at),
        }
    }

    /// Adds the label of a car that is seen.
    pub fn observe_label(&self, driver: usize, t: f64, evidence: &mut FrameEvidence) {
        let pose = |cars_at: f64, ego_at: f64| -> Isometry3<f64> {
            self.world.pose(0, ego_at).inverse() * self.world.pose(driver, cars_at)
        };
        let shift = |effect: &Effect| match effect {
            Effect::LabelOffset { offset_m } => Vector3::from(*offset_m),
            Effect::TimeOffset { seconds, clock } => {
                let ego_at = if *clock == Clock::Cloud { t + seconds } else { t };
                (pose(t, t).inverse() * pose(t + seconds, ego_at)).translation.vector
            }
            _ => Vector3::zeros(),
        };
        let shifts: Vec<Vector3<f64>> = self.effects.iter().map(shift).collect();
        let weight = 1.0 / self.own.labels_m.powi(2);
        evidence.labels.extend((0..3).map(|k| Row {
            columns: shifts.iter().map(|s| s[k]).collect(),
            frame: vec![],
            patch: None,
            weight,
        }));
    }

    /// Adds what depends on the number of shots alone.
    pub fn observe_shots(&self, evidence: &mut FrameEvidence) {
        let shots = self.shots() as f64;
        evidence.shots += shots;
        for (c, effect) in evidence.counts.iter_mut().zip(self.effects) {
            if let Effect::Outliers { share } = effect {
                c.clutter += share * shots;
                c.clutter_usual += self.nuisances.false_returns * shots;
                c.touched += share * shots;
            }
        }
    }

    /// Evidence without a shot.
    pub fn no_evidence(&self) -> FrameEvidence {
        FrameEvidence { counts: vec![Counts::default(); self.effects.len()], ..FrameEvidence::default() }
    }

    /// What the frames say together. Frames are independent: the ego vehicle drives more than a metre between them.
    pub fn judge(&self, frames: &[FrameEvidence]) -> Verdicts {
        let [shift, turn] = self.own.pose;
        let stds = FrameStds {
            means: vec![shift, shift, shift, turn, turn, turn],
            variances: vec![],
            losses: vec![],
            false_returns: 0.0,
            independent: 1.0,
        };
        let mut oracle = Oracle::new(self.effects.len(), (0..self.effects.len()).collect(), stds);
        frames.iter().for_each(|frame| oracle.add(frame));
        oracle.judge()
    }
}

/// Patches that are a little elsewhere in the simulation, with the standard deviation of their offset, m.
fn patch(hit: &Hit) -> Option<(u64, f64)> {
    let side = u64::from(hit.normal.x.abs() > hit.normal.y.abs()) * 2 + u64::from(hit.normal.x + hit.normal.y > 0.0);
    match (hit.car, hit.material) {
        (Some(car), _) => Some((100 + car as u64 * 4 + side, SURFACE_STD_M[1])),
        (None, Material::Concrete) if hit.range_m < REACH_M => Some((u64::from(hit.normal.y > 0.0), SURFACE_STD_M[0])),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use crate::case::{CAUSES, Kind, draw_case};
    use crate::write::write_case;
    use score::CaseSize;

    #[test]
    fn strong_effects_are_strong_and_weak_ones_weak() {
        let hidden = |seed: u64, cause: &str, frames: usize| {
            let kind = Kind::Single(CAUSES.iter().position(|c| *c == cause).unwrap());
            let case = draw_case(seed, kind, CaseSize { frames, shots: 4_000 });
            let folder =
                std::env::temp_dir().join(format!("lidarshift-strength-{}-{cause}-{frames}", std::process::id()));
            let truth = write_case(&case, &folder).unwrap();
            fs_err::remove_dir_all(&folder).unwrap();
            truth.hidden[0].clone()
        };
        for cause in CAUSES {
            let hidden = hidden(3, cause, 4);
            let nothing = cause == "ego_occlusion" && hidden.touched == 0.0;
            assert!(hidden.strength.unwrap() > 0.3 || nothing, "{hidden:?}");
        }
        let strength = |seed: u64, cause: &str, frames: usize| hidden(seed, cause, frames).strength.unwrap();
        let (few, many) = (strength(3, "label_offset", 2), strength(3, "label_offset", 8));
        assert!((many / few - 2.0).abs() < 0.5, "it grows with the root of the number of frames: {few} {many}");
    }
}
