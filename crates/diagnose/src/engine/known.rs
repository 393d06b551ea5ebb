//! What earlier searches found, to be undone before later ones.

use super::Engine;
use crate::channels::mask::Shown;
use crate::error::DiagnoseError;
use crate::pairing::{Corrections, FramePair, RangeError, Ray, ShownShift};
use crate::search::geometry::Displacement;
use crate::search::geometry::walk::Walk;
use crate::search::rolling_shutter::Slide;
use nalgebra::Vector3;

/// Quantisation step from which on the simulated side is rounded for all searches, m: coarse steps displace level
/// ground by the distance of rows.
const COARSE_M: f64 = 0.02;

/// What earlier searches found, to be corrected for later ones.
pub(super) struct Known {
    pub(super) slide: Option<Slide>,
    /// Quantisation step, m.
    pub(super) step_m: Option<f64>,
    /// Range walk.
    pub(super) walk: Option<Walk>,
    pub(super) displaced: Displacement,
}

impl Known {
    /// Quantisation step that matters to where surfaces lie, m.
    pub(super) fn coarse_m(&self) -> Option<f64> {
        self.step_m.filter(|step| *step > COARSE_M)
    }

    /// Displacement along the scan, m.
    pub(super) fn slide_m(&self, frame: usize, p: &Vector3<f64>, sensor: usize) -> Vector3<f64> {
        match &self.slide {
            Some(slide) => slide.shift_m(frame, p, sensor),
            None => Vector3::zeros(),
        }
    }

    /// Displacement of a measured point of a frame and a sensor along the scan, with the scene and with its row, m.
    pub(super) fn shift_m(
        &self,
        engine: &Engine,
        displaced: &Displacement,
        (frame, sensor): (usize, usize),
        p: &Vector3<f64>,
    ) -> Vector3<f64> {
        let pose = &engine.sensors.rig.sensors[sensor].pose();
        let of_row = displaced.of_row(p, sensor, engine.sensors, pose);
        let p = &(p - of_row);
        of_row + self.slide_m(frame, p, sensor) + displaced.of_point(p, (frame, sensor), &engine.origins[sensor])
    }

    /// Range walk of a measured return, m.
    pub(super) fn walk_m(&self, ray: &Ray) -> f64 {
        self.walk.map_or(0.0, |walk| walk.of(ray))
    }

    /// Frames with motion distortion, range walk and coarse quantisation corrected, in place of others; `None` where
    /// there is none.
    pub(super) fn standing(
        &self,
        engine: &Engine,
        others: Option<Vec<FramePair>>,
    ) -> Result<Option<Vec<FramePair>>, DiagnoseError> {
        if self.slide.is_none() && self.walk.is_none() && self.coarse_m().is_none() {
            return Ok(None);
        }
        let shift: ShownShift = &|frame, p, sensor| self.slide_m(frame, p, sensor);
        let shift_m = self.slide.as_ref().map(|_| shift);
        let walk: RangeError = &|ray| self.walk_m(ray);
        let range_m = self.walk.map(|_| walk);
        engine.pair(Corrections { shift_m, range_m, step_m: self.coarse_m() }, others).map(Some)
    }

    /// Frames with motion distortion, range walk, quantisation and a displacement undone, that of rows as well; and
    /// what is `left` of the motion distortion.
    pub(super) fn undone(
        &self,
        engine: &Engine,
        displaced: &Displacement,
        left: Option<&Slide>,
    ) -> Result<Vec<FramePair>, DiagnoseError> {
        let shift = |frame: usize, p: &Vector3<f64>, sensor: usize| {
            let left_m = left.map_or_else(Vector3::zeros, |slide| slide.shift_m(frame, p, sensor));
            self.shift_m(engine, displaced, (frame, sensor), p) + left_m
        };
        let walk: RangeError = &|ray| self.walk_m(ray);
        let range_m = self.walk.map(|_| walk);
        engine.pair(Corrections { shift_m: Some(&shift), range_m, step_m: self.coarse_m() }, None)
    }

    /// How the measured scene lies when silhouettes and single returns are compared.
    pub(super) fn shown(&self) -> Shown {
        match (self.slide.is_some() || self.displaced.rows_aim_elsewhere(), self.displaced.moves()) {
            (true, _) => Shown::Elsewhere,
            (false, true) => Shown::MovedBack,
            (false, false) => Shown::InPlace,
        }
    }
}
