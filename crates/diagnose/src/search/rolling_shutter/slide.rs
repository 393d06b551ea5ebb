//! How far the scene slides over a scan.

use crate::catalogue::Quantity;
use crate::channels::mean::Column;
use crate::channels::motion::OwnMotion;
use crate::inference::median;
use crate::pairing::FramePair;
use crate::search::geometry::Swept;
use crate::search::{Context, Found, NamedParameter, parameter};
use geometry::Box3;
use nalgebra::{Isometry3, Point3, Vector3};
use sensor::Sensor;

/// Displacement of the scene over a scan.
pub struct Slide {
    /// Duration of a scan from phase -1/2 to +1/2, s. Where the speed is not known it is 1, and velocities are
    /// displacements, m.
    pub(super) scan_s: f64,
    /// How unevenly it turns, s (see [`Sensor::uneven_phase`]).
    uneven_s: f64,
    /// Motion in every frame.
    motions: Vec<Motion>,
    /// Every sensor with `sensor_from_cloud`.
    sensors: Vec<(Sensor, Isometry3<f64>)>,
    /// What is reported of it, where it was seen from above.
    extent: Option<Extent>,
}

/// Motion in one frame: of the ego vehicle, and of the labelled objects relative to it, m/s.
pub(super) struct Motion {
    pub(super) own: OwnMotion,
    pub(super) objects: Vec<(Box3, Vector3<f64>)>,
}

impl Motion {
    /// Velocity of what is at a point relative to the ego vehicle, m/s.
    pub(super) fn at(&self, point: &Vector3<f64>, longest_s: f64) -> Vector3<f64> {
        let on = |(b, v): &&(Box3, Vector3<f64>)| {
            let margin = 0.5 + 0.5 * v.norm() * longest_s;
            let point = (*point).into();
            if b.is_far(point, margin) {
                return false;
            }
            let local = b.to_local(point);
            (0..2).all(|k| local[k].abs() < b.size[k] / 2.0 + margin) && local[2].abs() < b.size[2] / 2.0 + 0.3
        };
        match self.objects.iter().find(on) {
            Some((_, v)) => *v,
            None => -self.own.velocity_at(point),
        }
    }
}

/// Motion of the ego vehicle and of the objects in every frame; `None` where it is not known.
pub(super) fn driven(context: &Context) -> Option<Vec<Motion>> {
    let own = context.driving().filter(|_| context.times.is_some())?;
    let motion = |(f, own): (usize, OwnMotion)| {
        let boxes = context.frames[f].objects.iter().filter_map(|o| o.simulated);
        let moving = boxes.filter_map(|b| Some((b, context.seen_velocity(f, &b)?.relative_m_s)));
        Motion { own, objects: moving.collect() }
    };
    Some(own.into_iter().enumerate().map(motion).collect())
}

/// The same motion in every frame; objects are not displaced.
pub(super) fn alike(context: &Context, own: OwnMotion) -> Vec<Motion> {
    let still =
        |frame: &FramePair| frame.objects.iter().filter_map(|o| Some((o.simulated?, Vector3::zeros()))).collect();
    context.frames.iter().map(|frame| Motion { own, objects: still(frame) }).collect()
}

/// Relative error of the ego speed.
const OF_SPEED: f64 = 0.03;

/// Relative error of a displacement from above by the form of the scan. The even scan that fits an uneven one best
/// takes longer by 12 / (2 pi) of its unevenness: by a tenth where that is 0.05.
const OF_FORM: f64 = 0.1;

/// Relative error of a displacement from above.
pub(super) fn relative_error() -> f64 {
    OF_SPEED.hypot(OF_FORM)
}

/// The extent of a displacement over a scan.
#[derive(Clone, Debug)]
pub struct Extent {
    /// Duration of a scan, s; where the speed is not known the displacement against the heading, m.
    pub(super) scan_s: f64,
    /// Its standard error.
    pub(super) error: f64,
    /// How unevenly it turns, s, with its standard error, where it is known.
    pub(super) uneven_s: Option<[f64; 2]>,
    /// Median ego speed, m/s; 1 where it is not known.
    pub(super) middle_m_s: f64,
    /// Whether the ego speed is known.
    pub(super) speed_known: bool,
    /// Standard deviation of the displacements of frames where the speed is not known, m.
    pub(super) from_frame_to_frame: Option<f64>,
}

impl Extent {
    /// That of a scan whose duration surfaces show, at known speeds.
    pub fn of_duration([[scan_s, error], uneven_s]: [[f64; 2]; 2], driving: &[OwnMotion]) -> Extent {
        Extent {
            scan_s,
            error: error.hypot(OF_SPEED * scan_s),
            uneven_s: Some(uneven_s),
            middle_m_s: median(driving.iter().map(OwnMotion::speed_m_s).collect()),
            speed_known: true,
            from_frame_to_frame: None,
        }
    }

    /// Its parameters. Scans that turn clockwise have a positive duration.
    pub fn parameters(&self) -> Vec<NamedParameter> {
        let of = |quantity: Quantity, by: f64| parameter(quantity, by * self.scan_s, by.abs() * self.error);
        let duration = self.speed_known.then(|| of(Quantity::ScanS, -1.0));
        let share = |[by, error]: [f64; 2]| parameter(Quantity::Uneven, by / self.scan_s, (error / self.scan_s).abs());
        let uneven = self.uneven_s.map(share);
        duration.into_iter().chain([of(Quantity::ShearXM, -self.middle_m_s)]).chain(uneven).collect()
    }

    /// The finding in a sentence.
    pub fn says(&self) -> String {
        let slides_m = (self.middle_m_s * self.scan_s).abs();
        let speed = match self.from_frame_to_frame {
            None => format!(" at {:.0} m/s: a scan takes {:.0} ms", self.middle_m_s, 1e3 * self.scan_s.abs()),
            Some(spread) => format!(" in the mean, give or take {spread:.2} m from frame to frame"),
        };
        format!(
            "what stands still slides by {slides_m:.2} m over a scan{speed}, and nobody moves its points back; your simulator shoots all at once"
        )
    }
}

impl Slide {
    pub(super) fn new(context: &Context, scan_s: f64, motions: Vec<Motion>, extent: Option<Extent>) -> Slide {
        let sensors = context.rig.sensors.iter().map(|s| (s.clone(), s.pose().inverse())).collect();
        Slide { scan_s, uneven_s: 0.0, motions, sensors, extent }
    }

    /// What may be left of it on the surfaces once the scene was moved back. Where the speed is not known nothing is
    /// fitted to surfaces: single frames may be moved back wrongly by a metre, and surfaces are compared within
    /// decimetres.
    pub fn left(&self) -> &'static [Column] {
        let known = self.extent.as_ref().is_some_and(|extent| extent.speed_known);
        if known { &[Column::Scan, Column::Uneven] } else { &[] }
    }

    /// What surfaces show, to be undone.
    pub fn of_surfaces(context: &Context, swept: Swept) -> Slide {
        match swept {
            Swept::Duration([[scan_s, _], [uneven_s, _]]) => {
                let motions = driven(context).unwrap_or_default();
                Slide { uneven_s, ..Slide::new(context, scan_s, motions, None) }
            }
            Swept::Shear(shear) => {
                let [ahead_m, left_m, turn_rad] = shear.map(|[by, _]| -by);
                let (velocity_m_s, turn_rate_rad_s) = (Vector3::new(ahead_m, left_m, 0.0), Vector3::z() * turn_rad);
                Slide::new(context, 1.0, alike(context, OwnMotion { velocity_m_s, turn_rate_rad_s }), None)
            }
        }
    }

    /// With what is left on the surfaces once the scene was moved back, where that is the more certain: from above a
    /// cell is as large as a small displacement. `found` is the finding. Returns whether it is.
    pub fn refine(&mut self, found: &mut Found, left: Swept) -> bool {
        let (Some(extent), Swept::Duration([[by, error], uneven_s])) = (&mut self.extent, left) else { return false };
        let error = error.hypot(OF_SPEED * (extent.scan_s + by));
        let more_certain = error < extent.error;
        if more_certain {
            (extent.scan_s, extent.error, extent.uneven_s) = (extent.scan_s + by, error, Some(uneven_s));
            (found.parameters, found.says) = (extent.parameters(), extent.says());
            (self.scan_s, self.uneven_s) = (self.scan_s + by, uneven_s[0]);
        }
        more_certain
    }

    /// Displacement of a point of a frame and a sensor from its place in the middle of the scan, m, cloud's frame.
    pub fn shift_m(&self, frame: usize, point: &Vector3<f64>, sensor: usize) -> Vector3<f64> {
        let (mount, sensor_from_cloud) = &self.sensors[sensor];
        let [azimuth_rad, elevation_rad, _] = Sensor::spherical(&(sensor_from_cloud * Point3::from(*point)));
        let phase = mount.scan_phase(azimuth_rad, elevation_rad);
        self.motions[frame].at(point, self.scan_s.abs())
            * (phase * self.scan_s + Sensor::uneven_phase(phase) * self.uneven_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::catalogue::{Cause, Channel, Covariate};
    use crate::curve::Curve;
    use crate::diagnosis::Status;
    use crate::inference::roles::roles;
    use sensor::Rig;

    /// A slide of 0.4 m at 8 m/s as it is seen from above, and its finding.
    fn from_above(context: &Context) -> (Slide, Found) {
        let extent = Extent {
            scan_s: 0.05,
            error: 0.006,
            uneven_s: None,
            middle_m_s: 8.0,
            speed_known: true,
            from_frame_to_frame: None,
        };
        let found = Found {
            effects: vec![],
            status: Status::Named,
            causes: vec![Cause::RollingShutter],
            parameters: extent.parameters(),
            confidence: 1.0,
            channel: Channel::Slide,
            covariate: Covariate::ScanPhase,
            held_out_gains: vec![],
            says: extent.says(),
            separate_by: None,
            curve: Curve { x: "s".into(), y: "1".into(), by_sensor: false, points: vec![] },
        };
        (Slide::new(context, 0.05, driven(context).unwrap(), Some(extent)), found)
    }

    #[test]
    fn what_surfaces_show_counts_where_it_is_more_certain() {
        let rig = Rig::single();
        let frames: Vec<FramePair> = (0..20).map(|f| FramePair::of_rays(f.to_string(), vec![], vec![])).collect();
        let context = Context {
            rig: &rig,
            frames: &frames,
            roles: roles(20),
            times: Some((0..20).map(f64::from).collect()),
            motion: Some(vec![Some(OwnMotion::ahead(8.0)); 20]),
            to_next: vec![],
        };
        let (mut slide, mut found) = from_above(&context);
        assert_eq!(slide.left(), [Column::Scan, Column::Uneven]);
        slide.refine(&mut found, Swept::Duration([[-0.01, 0.01], [0.002, 0.0001]]));
        assert_eq!(found.parameter(Quantity::ScanS).unwrap().estimate, -0.05, "less certain than from above");
        slide.refine(&mut found, Swept::Duration([[-0.01, 0.001], [0.002, 0.0001]]));
        assert!((found.parameter(Quantity::ScanS).unwrap().estimate + 0.04).abs() < 1e-12);
        assert!((found.parameter(Quantity::Uneven).unwrap().estimate - 0.05).abs() < 1e-12);
        assert!(found.says.contains("slides by 0.32 m"), "{}", found.says);
        // To the left, at a quarter of the scan.
        let shift_m = slide.shift_m(3, &Vector3::new(0.0, 10.0, 0.0), 0);
        assert!((shift_m - Vector3::new(-8.0 * (0.25 * 0.04 + 0.002), 0.0, 0.0)).norm() < 1e-9, "{shift_m}");
    }

    #[test]
    fn a_shear_of_surfaces_moves_all_that_stands() {
        let rig = Rig::single();
        let frames = [FramePair::of_rays("0".into(), vec![], vec![])];
        let context =
            Context { rig: &rig, frames: &frames, roles: roles(1), times: None, motion: None, to_next: vec![] };
        let slide = Slide::of_surfaces(&context, Swept::Shear([[0.4, 0.0], [0.0; 2], [0.02, 0.0]]));
        assert!(slide.left().is_empty());
        let shift_m = slide.shift_m(0, &Vector3::new(0.0, 10.0, 0.0), 0);
        assert!((shift_m - Vector3::new(0.25 * (0.4 - 0.2), 0.0, 0.0)).norm() < 1e-9, "{shift_m}");
    }
}
