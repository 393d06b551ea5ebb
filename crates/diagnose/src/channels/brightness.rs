//! Ranges against brightness: how much longer or shorter a range is on a bright spot than beside it on the same
//! surface. A surface that stands elsewhere than in the simulation displaces both alike, whatever its brightness.

use super::intensity::Column;
use super::mean::{KINDS, kind_of, usable, weight};
use super::own_poses::{OwnPoses, mounts, off_surface_m};
use crate::pairing::{FramePair, OCTANTS, Ray};
use nalgebra::{SMatrix, SVector};
use rayon::prelude::*;
use sensor::Rig;
use sensor::effects::ReflectivityWalk;
use std::collections::BTreeMap;

/// Width and height of a patch of directions, rad.
const PATCH_RAD: [f64; 2] = [0.12, 0.05];

/// Fewest returns of a patch.
const FEWEST: f64 = 8.0;

/// Smallest intensity that tells a brightness, in steps of the column.
const STEPS: f64 = 3.0;

/// Largest deviation of the brightness of a return from that of the simulated returns around it, in units of the spread
/// over all returns of each side.
const EVEN: f64 = 0.5;

/// Columns that the fall of a column of intensities is fitted with: the kinds of surfaces, range and incidence.
const OF_FALL: usize = KINDS + 2;

/// The brightness of surfaces by a column of intensities: the logarithm of an intensity, without what range and
/// incidence do to it in the mean over the returns of each kind of surface.
#[derive(Clone, Copy, Debug)]
pub struct Brightness {
    /// Smallest intensity that is used.
    least: f64,
    /// Logarithm of the intensity of mean brightness, at 20 m and at normal incidence.
    middle_ln: f64,
    /// Exponent of the fall with range, and with the cosine of incidence.
    fall: [f64; 2],
    /// Standard deviation over the returns.
    spread: f64,
}

impl Brightness {
    /// By the intensities of some returns; `None` where they do not tell surfaces apart.
    pub fn of<'a>(rays: impl Iterator<Item = &'a Ray> + Clone) -> Option<Brightness> {
        let rays = rays.filter(|r| usable(r) && r.intensity.is_finite());
        let column = Column::of(rays.clone());
        if !column.tells_surfaces() {
            return None;
        }
        let least = STEPS * column.step;
        let bright = || rays.clone().filter_map(|r| Some((r, ln_above(r.intensity, least)?)));
        let mut gram = SMatrix::<f64, OF_FALL, OF_FALL>::identity() * 1e-6;
        let mut right = SVector::<f64, OF_FALL>::zeros();
        for (ray, ln) in bright() {
            let mut x = SVector::<f64, OF_FALL>::zeros();
            x[kind_of(ray)] = 1.0;
            x.fixed_rows_mut::<2>(KINDS).copy_from_slice(&of_fall(ray));
            gram.ger(1.0, &x, &x, 1.0);
            right += x * ln;
        }
        let fitted = gram.cholesky()?.solve(&right);
        let fall = [-fitted[KINDS], fitted[KINDS + 1]];
        let mut own = Brightness { least, middle_ln: 0.0, fall, spread: 0.0 };
        let [n, sum, squares] = bright()
            .filter_map(|(ray, _)| own.by(ray, ray.intensity))
            .fold([0.0; 3], |s, b| [s[0] + 1.0, s[1] + b, s[2] + b * b]);
        let count: f64 = f64::max(n, 1.0);
        own.middle_ln = sum / count;
        own.spread = (squares / count - own.middle_ln.powi(2)).max(0.0).sqrt();
        Some(own)
    }

    /// Brightness of the surface of a return over the mean by an intensity, ln; `None` where it is too small to tell.
    fn by(&self, ray: &Ray, intensity: f32) -> Option<f64> {
        let [range, incidence] = of_fall(ray);
        Some(ln_above(intensity, self.least)? + self.fall[0] * range - self.fall[1] * incidence - self.middle_ln)
    }

    /// Brightness of the surface of a return as the sensor sees it, ln: of its incidence nothing is taken out.
    pub fn towards_sensor(&self, ray: &Ray) -> Option<f64> {
        Some(ln_above(ray.intensity, self.least)? + self.fall[0].max(0.0) * of_fall(ray)[0])
    }

    /// The same against that elsewhere on its plane, ln. Over a plane the logarithm of the cosine of incidence is that
    /// of the range with the opposite sign, and an estimated cosine scatters where returns are few.
    fn on_a_plane(&self, ray: &Ray, intensity: f32) -> Option<f64> {
        Some(ln_above(intensity, self.least)? + (self.fall[0] + self.fall[1]) * of_fall(ray)[0])
    }

    /// The effect that changes ranges by `walk_m` for each factor e of this brightness.
    pub fn effect(&self, walk_m: f64) -> ReflectivityWalk {
        let round = |v| crate::effects::rounded(v, 5);
        ReflectivityWalk {
            walk_m: round(walk_m),
            reference: crate::effects::rounded(self.middle_ln.exp(), 7),
            of_intensity: true,
            range_exponent: round(self.fall[0]),
            incidence_exponent: round(self.fall[1]),
        }
    }
}

/// The brightness of surfaces by both sides.
#[derive(Clone, Copy, Debug)]
pub struct Brightnesses {
    measured: Brightness,
    /// By the simulated intensities, on which effects act.
    pub simulated: Brightness,
}

impl Brightnesses {
    /// Of a pair; `None` where the intensities of a side do not tell surfaces apart.
    pub fn of(frames: &[FramePair]) -> Option<Brightnesses> {
        Some(Brightnesses {
            measured: Brightness::of(frames.iter().flat_map(|f| &f.measured))?,
            simulated: Brightness::of(frames.iter().flat_map(|f| &f.simulated))?,
        })
    }

    /// Brightness of the simulated surface around a measured return over the mean, ln. It does not depend on the error
    /// of the return's own range.
    pub fn ln(&self, ray: &Ray) -> Option<f64> {
        self.simulated.by(ray, ray.intensity_simulated)
    }

    /// The same against that elsewhere on its plane, where the return is as bright as the simulated ones around it: at
    /// the edge of a bright spot, as at that of a window in a wall, the surface is another one as well.
    fn on_a_plane(&self, ray: &Ray) -> Option<f64> {
        let own = self.measured.by(ray, ray.intensity)? / self.measured.spread;
        let unlike = own - self.ln(ray)? / self.simulated.spread;
        self.simulated.on_a_plane(ray, ray.intensity_simulated).filter(|_| unlike.abs() < EVEN)
    }
}

/// Logarithm of an intensity that is not too small.
fn ln_above(intensity: f32, least: f64) -> Option<f64> {
    let own = f64::from(intensity);
    (own > 0.0 && own >= least).then(|| own.ln())
}

/// Logarithms of range, over that at which effects have no fall, and of the cosine of incidence.
fn of_fall(ray: &Ray) -> [f64; 2] {
    let range = f64::from(ray.range_m).max(0.1) / ReflectivityWalk::REFERENCE_M;
    [range.ln(), f64::from(ray.cos_incidence).max(ReflectivityWalk::LEAST_COS).ln()]
}

/// Sums of one frame.
#[derive(Clone, Debug, Default)]
pub struct BrightFrame {
    /// By direction about the vehicle: the square of the lever of brightness, and its product with what is measured.
    pub octants: [[f64; 2]; OCTANTS],
    /// Squares that the patches leave, in units of the assumed variance.
    pub squares: f64,
    /// Degrees of freedom of these squares.
    pub freedom: f64,
}

/// Columns of a patch that its returns have in common: its offset, an offset of ranges, and its turns. A plane that is
/// turned a little lies beside the simulated one by what grows with range, and so does the intensity of a plane of one
/// brightness fall.
const COMMON: usize = 4;

/// All columns of a patch, the logarithm of intensities and the measured distance last.
const OF_PATCH: usize = COMMON + 2;

/// The sums of all frames. What the returns of a patch have in common is taken out.
pub fn bright_frames(
    frames: &[FramePair],
    rig: &Rig,
    poses: &[OwnPoses],
    brightness: &Brightnesses,
    noise_m: f64,
) -> Vec<BrightFrame> {
    let mounts = mounts(rig);
    let one = |(frame, pose): (&FramePair, &OwnPoses)| {
        let mut patches = BTreeMap::<(u8, usize, usize, [i32; 2]), (f64, SMatrix<f64, OF_PATCH, OF_PATCH>)>::new();
        for ray in frame.measured.iter().filter(|r| usable(r)) {
            let Some(y) = off_surface_m(ray, &mounts[usize::from(ray.sensor)], pose) else { continue };
            let Some(bright) = brightness.on_a_plane(ray) else { continue };
            let at = [ray.azimuth_rad, ray.elevation_rad].map(f64::from);
            let place = [0, 1].map(|k| (at[k] / PATCH_RAD[k]).floor() as i32);
            let lever = ray.range_lever();
            let turned = [0, 1].map(|k| (at[k] - (f64::from(place[k]) + 0.5) * PATCH_RAD[k]) * f64::from(ray.range_m));
            let x = SVector::from([1.0, lever, turned[0], turned[1], lever * bright, y]);
            let (n, sums) = patches.entry((ray.sensor, ray.octant(), kind_of(ray), place)).or_default();
            *n += 1.0;
            sums.ger(weight(ray, noise_m), &x, &x, 1.0);
        }
        let mut out = BrightFrame::default();
        for ((_, octant, ..), (n, sums)) in patches.into_iter().filter(|(_, (n, _))| *n >= FEWEST) {
            let (mut left, taken) = without_common(sums);
            let [bright, distance] = [COMMON, COMMON + 1];
            // Ranges scatter otherwise on each surface than is assumed of all.
            let scatter = left[(distance, distance)] / (n - taken).max(1.0);
            left /= scatter.max(1.0);
            out.octants[octant][0] += left[(bright, bright)];
            out.octants[octant][1] += left[(bright, distance)];
            out.squares += left[(distance, distance)];
            out.freedom += n - taken;
        }
        out
    };
    frames.par_iter().zip(poses).map(one).collect()
}

/// Share of a column's square beyond what other columns explain, up to which the rest is rounding.
const SAME: f64 = 1e-9;

/// The products of a patch without what its returns have in common, and how many numbers that are.
fn without_common(mut sums: SMatrix<f64, OF_PATCH, OF_PATCH>) -> (SMatrix<f64, OF_PATCH, OF_PATCH>, f64) {
    let whole = sums.diagonal();
    let mut taken = 0.0;
    for column in 0..COMMON {
        let left = sums[(column, column)];
        if left > SAME * whole[column] {
            let by = sums.column(column).into_owned();
            sums -= by * by.transpose() / left;
            taken += 1.0;
        }
    }
    (sums, taken)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channels::own_poses::OWN_NUMBERS;
    use nalgebra::Vector3;
    use sensor::Rig;

    /// Intensity in counts of a wall with bright and dark fields, which falls with range and incidence.
    fn counts(bright: bool, range_m: f64, cos: f64) -> f64 {
        let reflectivity = if bright { 0.6 } else { 0.1 };
        200.0 * reflectivity * (10.0 / range_m).powf(1.5) * cos
    }

    /// Walls to the left at some distances; ranges are `walk_m` longer for each factor e of brightness, and dark fields
    /// stand back by `inset_m` on both sides.
    fn frame(walk_m: f64, inset_m: f64) -> FramePair {
        let mut measured = Vec::new();
        for (wall, (column, row)) in (0..4).flat_map(|w| (0..160).flat_map(move |c| (0..12).map(move |r| (w, (c, r)))))
        {
            let azimuth = 0.3 + 0.6 * f64::from(wall) + 0.0035 * f64::from(column);
            let elevation = -0.06 + 0.01 * f64::from(row);
            let (sin, cos) = elevation.sin_cos();
            let direction = Vector3::new(cos * azimuth.cos(), cos * azimuth.sin(), sin);
            let range_m = (6.0 + 5.0 * f64::from(wall)) / direction.y;
            let place = direction.x * range_m;
            let bright = (place / 0.8).rem_euclid(2.0) < 1.0;
            let at_edge = (place / 0.8).rem_euclid(1.0).min(1.0 - (place / 0.8).rem_euclid(1.0)) < 0.05;
            let own = counts(bright, range_m, direction.y);
            let mixed = 0.5 * (counts(true, range_m, direction.y) + counts(false, range_m, direction.y));
            let off_m = if bright { 6f64.ln() } else { 0.0 } * walk_m;
            // Beside an edge a plane lies between the two fields.
            let amiss_m = if at_edge { if bright { -0.5 * inset_m } else { 0.5 * inset_m } } else { 0.0 };
            measured.push(Ray {
                normal: [0.0, -1.0, 0.0],
                cos_incidence: direction.y as f32,
                residual_m: (off_m + amiss_m + 0.002 * (f64::from(column * 7 + row * 3).sin())) as f32,
                intensity: own as f32,
                intensity_simulated: if at_edge { mixed } else { own } as f32,
                ..Ray::standing(&(direction * range_m))
            });
        }
        let beside = |ray: &Ray| Ray { intensity_beside: ray.intensity, ..*ray };
        let measured: Vec<Ray> = measured.iter().map(beside).collect();
        FramePair::of_rays(String::new(), measured.clone(), measured)
    }

    fn walk_m(frame: FramePair) -> (Brightness, f64, f64) {
        let brightness = Brightnesses::of(std::slice::from_ref(&frame)).expect("fields");
        let poses = [vec![SVector::<f64, OWN_NUMBERS>::zeros()]];
        let sums = bright_frames(&[frame], &Rig::single(), &poses, &brightness, 0.005).remove(0);
        let [gram, right] = [0, 1].map(|k: usize| sums.octants.iter().map(|o| o[k]).sum::<f64>());
        (brightness.simulated, right / gram, 1.0 / gram.sqrt())
    }

    #[test]
    fn the_brightness_is_without_the_fall_of_the_column() {
        let (brightness, ..) = walk_m(frame(0.0, 0.0));
        let [range, incidence] = brightness.fall;
        assert!((range - 1.5).abs() < 0.1 && (incidence - 1.0).abs() < 0.15, "{range} {incidence}");
        assert!((brightness.spread - 0.5 * 6f64.ln()).abs() < 0.05, "{}", brightness.spread);
    }

    #[test]
    fn bright_fields_of_a_wall_tell_a_walk() {
        for by_m in [0.02, -0.01, 0.0] {
            let (_, found_m, error_m) = walk_m(frame(by_m, 0.0));
            assert!((found_m - by_m).abs() < 3.0 * error_m && error_m < 5e-4, "{by_m} {found_m} {error_m}");
        }
    }

    #[test]
    fn dark_windows_that_stand_back_are_no_walk() {
        let (_, found_m, _) = walk_m(frame(0.0, 0.2));
        assert!(found_m.abs() < 1e-3, "{found_m}");
    }
}
