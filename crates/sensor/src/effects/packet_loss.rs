//! B9: lost packets and sensor outages.

use super::{Draws, FrameContext, Need, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The shots of a sensor are transmitted in packets of `packet_ms`. A packet is lost with probability `loss` if the
/// previous packet arrived, and with probability `burst` if the previous packet was lost (Gilbert channel). With
/// probability `outage` all points of a sensor are missing in a frame.
///
/// Typical: 0.1 to 5 % of the packets, in bursts: loss 0.002, burst 0.5.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PacketLoss {
    /// Duration of a packet, ms.
    pub packet_ms: f64,
    /// Probability that a packet is lost if the previous one arrived, 0 to 1.
    pub loss: f64,
    /// Probability that a packet is lost if the previous one was lost, 0 to 1.
    pub burst: f64,
    /// Probability that a sensor is missing in a frame, 0 to 1.
    pub outage: f64,
}

impl Default for PacketLoss {
    fn default() -> Self {
        PacketLoss { packet_ms: 0.5, loss: 0.0, burst: 0.0, outage: 0.0 }
    }
}

impl SensorEffect for PacketLoss {
    fn check(&self) -> Result<(), KeyError> {
        within("packet_ms", self.packet_ms, 1e-3, 1000.0)?;
        within("loss", self.loss, 0.0, 1.0)?;
        within("burst", self.burst, 0.0, 1.0)?;
        within("outage", self.outage, 0.0, 1.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(&[Need::Time])
    }

    fn reads(&self) -> Reads {
        Reads::PATTERN | Reads::EMPTY_SHOTS
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        let packet = |time_s: f32| (f64::from(time_s) * 1e3 / self.packet_ms).floor() as i64;
        let mut spans: BTreeMap<u8, (i64, i64)> = BTreeMap::new();
        for echo in &scan.echoes {
            let here = packet(echo.time_s);
            let span = spans.entry(echo.sensor).or_insert((here, here));
            *span = (span.0.min(here), span.1.max(here));
        }
        let mut random = draws.of_frame();
        let lost: BTreeMap<u8, (i64, Vec<bool>)> = spans
            .into_iter()
            .map(|(sensor, (first, last))| {
                let outage = random.random_bool(self.outage);
                let mut before = false;
                let lost = (first..=last).map(|_| {
                    before = random.random_bool(if before { self.burst } else { self.loss });
                    before || outage
                });
                (sensor, (first, lost.collect()))
            })
            .collect();
        for echo in scan.returns_mut() {
            let (first, lost) = &lost[&echo.sensor];
            if lost[(packet(echo.time_s) - first) as usize] {
                echo.lose();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn losses_come_in_bursts() {
        let before = scene();
        let effect = PacketLoss { packet_ms: 0.1, loss: 0.02, burst: 0.6, outage: 0.0 };
        let (mut gone, mut all, mut starts) = (0, 0, 0);
        for frame in 0..40 {
            let after = applied_in(frame, &effect, &before);
            let mut was_lost = false;
            for (_, b) in before.echoes.iter().zip(&after.echoes).filter(|(a, _)| a.is_return()) {
                let is_lost = !b.is_return();
                gone += usize::from(is_lost);
                all += 1;
                starts += usize::from(is_lost && !was_lost);
                was_lost = is_lost;
            }
        }
        // The fraction lost is loss / (loss + 1 - burst), in bursts of 1 / (1 - burst) packets of 23 shots.
        let share = gone as f64 / all as f64;
        assert!((share - 0.02 / 0.42).abs() < 0.012, "{share}");
        let length = gone as f64 / starts as f64;
        assert!((30.0..80.0).contains(&length), "{length} shots per burst");
    }

    #[test]
    fn an_outage_removes_all_points_of_a_sensor() {
        let before = scene();
        let effect = PacketLoss { outage: 0.3, ..PacketLoss::default() };
        let shares: Vec<f64> = (0..200).map(|frame| lost(&before, &applied_in(frame, &effect, &before))).collect();
        assert!(shares.iter().all(|s| *s == 0.0 || *s == 1.0));
        let (mean, _) = moments(&shares);
        assert!((mean - 0.3).abs() < 0.1, "{mean}");
    }
}
