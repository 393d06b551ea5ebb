//! Runs of lost bins: the length of a packet, and how losses follow each other.

use super::{Bin, Counts};
use std::collections::BTreeSet;

/// Share of what is lost that is lost by single packets, at least: (1 - burst)^2.
const OF_SINGLES: f64 = 0.05;

/// Largest probability that another packet is lost after a lost one.
const MOST_BURST: f64 = 0.8;

/// Runs of dark bins of the sensor that has most of them.
pub(super) struct Runs {
    pub(super) sensor: usize,
    /// Width of a bin, as a share of a scan.
    bin: f64,
    /// Length of each run as a share of a scan, with the parts of bins at its ends.
    pub(super) lengths: Vec<f64>,
    /// Length of all bins that were judged, in scans.
    all: f64,
}

impl Runs {
    pub(super) fn new(dark: &[BTreeSet<Bin>], counts: &[Counts], frames: &[usize], widths: &[f64]) -> Self {
        let of_sensor = |s: usize| frames.iter().flat_map(|&i| &dark[i]).filter(|b| usize::from(b.0) == s).count();
        let sensor = (0..widths.len()).max_by_key(|s| (of_sensor(*s), usize::MAX - s)).unwrap_or(0);
        let own = |bin: &&Bin| usize::from(bin.0) == sensor;
        let mut lengths = Vec::new();
        for &i in frames {
            let mut last = None;
            for (_, bin) in dark[i].iter().filter(own) {
                match lengths.last_mut() {
                    Some(length) if last == Some(bin - 1) => *length += widths[sensor],
                    // A packet covers half a bin more at each end.
                    _ => lengths.push(2.0 * widths[sensor]),
                }
                last = Some(*bin);
            }
        }
        let judged = frames.iter().flat_map(|&i| counts[i].keys()).filter(own).count();
        Runs { sensor, bin: widths[sensor], lengths, all: judged as f64 * widths[sensor] }
    }

    /// Length of a packet as a share of a scan. Most bursts are short, so that the shortest runs are single packets;
    /// but the shortest ones that hold together less than a twentieth of what is lost may be no packets at all.
    pub(super) fn packet(&self) -> f64 {
        let mut sorted = self.lengths.clone();
        sorted.sort_by(f64::total_cmp);
        let lost: f64 = sorted.iter().sum();
        let mut so_far = 0.0;
        let single = sorted.into_iter().find(|length| {
            so_far += length;
            so_far > OF_SINGLES * lost
        });
        single.unwrap_or(self.bin)
    }

    /// Where the length of a packet lies (95 %): it is known to a bin, and of few runs none may be a single packet.
    pub(super) fn packet_interval(&self) -> [f64; 2] {
        let [least, most] = [-self.bin, self.bin].map(|error| (self.packet() + error).max(self.bin));
        let none_single = MOST_BURST.powf(self.lengths.len() as f64) > 0.025;
        [if none_single { self.bin } else { least }, most]
    }

    /// Probabilities of a loss after a packet that arrived, and after one that was lost (a Gilbert channel), for a
    /// length of packets.
    pub(super) fn probabilities(&self, packet: f64) -> [f64; 2] {
        let lost: f64 = self.lengths.iter().sum();
        let arrived = ((self.all - lost) / packet).max(1.0);
        let runs = self.lengths.len() as f64;
        [(runs / arrived).min(1.0), (1.0 - runs * packet / lost.max(1e-9)).max(0.0)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_few_runs_none_may_be_a_single_packet() {
        let runs = |n: usize| Runs { sensor: 0, bin: 0.01, lengths: vec![0.04; n], all: 30.0 };
        assert_eq!(runs(2).packet_interval(), [0.01, 0.05]);
        let [low, high] = runs(20).packet_interval();
        assert!((low - 0.03).abs() < 1e-9 && (high - 0.05).abs() < 1e-9);
    }
}
