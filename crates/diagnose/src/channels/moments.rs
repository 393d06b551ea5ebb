//! Moments of frames: when in the recording they are, and how the ego vehicle moves then. Effects that change from
//! frame to frame are columns of the fit times a number of the moment.

use crate::channels::motion::OwnMotion;
use crate::inference::median;

/// Time constants of courses, as shares of the length of the recording. The last one is nearly a straight line.
const TIME_CONSTANTS: [f64; COURSES] = [0.2, 0.5, 2.0];

/// Number of courses that a drift may take.
pub const COURSES: usize = 3;

/// The moment of a frame.
#[derive(Clone, Copy, Debug)]
pub struct Moment {
    /// Time since the first frame, s.
    pub time_s: f64,
    /// The same as a share of the length of the recording.
    pub passed: f64,
    /// Ego motion; at rest where it is not known.
    pub own: OwnMotion,
}

impl Default for Moment {
    fn default() -> Self {
        Moment { time_s: 0.0, passed: 0.0, own: OwnMotion::ahead(0.0) }
    }
}

impl Moment {
    /// What has come by now of a drift of one of the courses, `1 - exp(-t / T)`: 0 at the beginning of the recording, 1
    /// at its end.
    pub fn course(&self, k: usize) -> f64 {
        (1.0 - (-self.passed / TIME_CONSTANTS[k]).exp()) * final_share(k)
    }

    /// The square of the speed, in units of (10 m/s)^2: what a pitch by the load of the air, or by that of driving,
    /// grows with.
    pub fn lean(&self) -> f64 {
        lean_at(self.own.speed_m_s())
    }
}

/// [`Moment::lean`] at a speed, m/s.
pub fn lean_at(speed_m_s: f64) -> f64 {
    (speed_m_s / 10.0).powi(2)
}

/// Moments of all frames, and what is known of them.
#[derive(Clone, Debug, Default)]
pub struct Moments {
    /// Of each frame.
    pub of_frames: Vec<Moment>,
    /// Whether times are known.
    pub passes: bool,
    /// Whether the ego motion is known and not at rest.
    pub drives: bool,
    /// Whether a pitch that grows with the speed can be distinguished from a constant one.
    pub speed_varies: bool,
}

/// Standard deviation of the squared speed over its mean from which on a pitch that grows with it is not a constant
/// one: either then leaves at least 4 % of the other, more than trials of a search may differ by and count as equal.
const LEAST_VARIED: f64 = 0.2;

impl Moments {
    /// Of a number of frames, with what is known of them.
    pub fn new(frames: usize, times: Option<&[f64]>, driving: Option<Vec<OwnMotion>>) -> Self {
        let [first, last] = times.map_or([0.0; 2], |t| [t.first(), t.last()].map(|t| t.copied().unwrap_or(0.0)));
        let moment = |f: usize| {
            let time_s = times.map_or(0.0, |t| t[f] - first);
            let own = driving.as_ref().map_or(OwnMotion::ahead(0.0), |own| own[f]);
            Moment { time_s, passed: time_s / (last - first).max(1e-9), own }
        };
        let of_frames: Vec<Moment> = (0..frames).map(moment).collect();
        let squares: Vec<f64> = of_frames.iter().map(Moment::lean).collect();
        let mean = squares.iter().sum::<f64>() / squares.len().max(1) as f64;
        let variance = squares.iter().map(|s| (s - mean).powi(2)).sum::<f64>() / squares.len().max(1) as f64;
        Moments {
            of_frames,
            passes: last > first,
            drives: driving.is_some(),
            speed_varies: variance.sqrt() > LEAST_VARIED * mean,
        }
    }

    /// Median ego speed, m/s; 0 where it is not known.
    pub fn middle_m_s(&self) -> f64 {
        median(self.of_frames.iter().map(|moment| moment.own.speed_m_s().abs()).collect())
    }

    /// Largest [`Moment::lean`].
    pub fn most_lean(&self) -> f64 {
        self.of_frames.iter().map(Moment::lean).fold(0.0, f64::max)
    }

    /// Time constant of a course, s.
    pub fn time_constant_s(&self, k: usize) -> f64 {
        TIME_CONSTANTS[k] * self.of_frames.last().map_or(0.0, |last| last.time_s)
    }
}

/// A drift at its end over that at the end of the recording.
pub fn final_share(k: usize) -> f64 {
    1.0 / (1.0 - (-1.0 / TIME_CONSTANTS[k]).exp())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn courses_begin_at_0_and_end_at_1() {
        let moments = Moments::new(3, Some(&[5.0, 10.0, 25.0]), None);
        for k in 0..COURSES {
            let [first, middle, last] = [0, 1, 2].map(|f: usize| moments.of_frames[f].course(k));
            assert!(first == 0.0 && middle > 0.25 && middle < 1.0 && (last - 1.0).abs() < 1e-12, "{k}: {middle}");
            // As the simulator has it: `drift_m (1 - exp(-t / time_constant_s))`.
            let as_effect = final_share(k) * (1.0 - (-5.0 / moments.time_constant_s(k)).exp());
            assert!((as_effect - middle).abs() < 1e-12, "{k}: {as_effect} {middle}");
        }
        assert!(moments.passes && !moments.drives && !moments.speed_varies);
    }

    #[test]
    fn a_pitch_that_grows_with_the_speed_needs_speeds_that_vary() {
        let varies = |speeds: [f64; 4]| Moments::new(4, None, Some(speeds.map(OwnMotion::ahead).to_vec())).speed_varies;
        assert!(varies([8.0, 10.0, 12.0, 10.0]) && !varies([9.6, 10.0, 10.4, 10.0]) && !varies([0.0; 4]));
    }
}
