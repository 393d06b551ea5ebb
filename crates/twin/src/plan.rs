//! Which frames a map is made of, and which are shot with it: no frame is held against itself.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Which frames are left out of the map that a frame is shot with.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Leave {
    /// Every second frame: even frames are shot with the map of the odd ones, and the other way round.
    Alternate,
    /// All frames that are nearer in time than this, s.
    Seconds(f64),
}

/// A map and what is shot with it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Job {
    /// Frames of which the map is made.
    pub map: Vec<usize>,
    /// Frames that are shot.
    pub shoot: Vec<usize>,
}

/// Frames that are shot with one map, and frames before and after them of which it is made as well. A map holds no more
/// than this, so that memory does not grow with the recording.
const WINDOW: usize = 100;
const AROUND: usize = 40;

/// The jobs of a recording whose frames have these times (s).
///
/// Jobs without a frame in their map are left out, with the frames that they would have shot.
pub fn jobs(times_s: &[f64], leave: Leave) -> Vec<Job> {
    let n = times_s.len();
    let near = |window: &Range<usize>| window.start.saturating_sub(AROUND)..(window.end + AROUND).min(n);
    let mut jobs = Vec::new();
    match leave {
        Leave::Alternate => {
            for window in windows(n, |first, next| next - first >= WINDOW) {
                for parity in 0..2 {
                    let map = near(&window).filter(|f| f % 2 != parity).collect();
                    jobs.push(Job { map, shoot: window.clone().filter(|f| f % 2 == parity).collect() });
                }
            }
        }
        Leave::Seconds(seconds) => {
            let full = |first: usize, next: usize| times_s[next] - times_s[first] >= seconds || next - first >= WINDOW;
            for window in windows(n, full) {
                let (from, to) = (times_s[window.start] - seconds, times_s[window.end - 1] + seconds);
                let map = near(&window).filter(|f| times_s[*f] <= from || times_s[*f] >= to).collect();
                jobs.push(Job { map, shoot: window.collect() });
            }
        }
    }
    jobs.retain(|job| !job.map.is_empty() && !job.shoot.is_empty());
    jobs
}

/// Divides `n` frames: a window ends before the first frame for which `full(first, frame)`.
fn windows(n: usize, full: impl Fn(usize, usize) -> bool) -> Vec<Range<usize>> {
    let (mut all, mut first) = (Vec::new(), 0);
    for frame in 1..=n {
        if frame == n || full(first, frame) {
            all.push(first..frame);
            first = frame;
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_frame_is_shot_once_and_never_with_itself(n in 2_usize..400, seconds in 0.1_f64..3.0) {
            let times: Vec<f64> = (0..n).map(|f| 0.1 * f as f64).collect();
            for leave in [Leave::Alternate, Leave::Seconds(seconds)] {
                let mut shot = vec![0; n];
                for job in jobs(&times, leave) {
                    prop_assert!(job.map.len() <= WINDOW + 2 * AROUND);
                    for f in &job.shoot {
                        shot[*f] += 1;
                        prop_assert!(!job.map.contains(f));
                        if let Leave::Seconds(seconds) = leave {
                            prop_assert!(job.map.iter().all(|m| (times[*m] - times[*f]).abs() >= seconds - 1e-9));
                        }
                    }
                }
                prop_assert!(shot.iter().all(|s| *s <= 1));
                if leave == Leave::Alternate || n as f64 * 0.1 > 4.0 * seconds {
                    prop_assert!(shot.iter().all(|s| *s == 1));
                }
            }
        }
    }
}
