//! Effects on clouds in memory. They get the bits that they have as frames of a finished data set.

use crate::cloud_scan::CloudReader;
use crate::effects::{EffectList, FrameContext};
use crate::finished::{Refusal, STREAM, cloud_of, refusals_of};
use crate::material::MaterialTable;
use crate::rig::Rig;
use data::Cloud;

/// A list of effects with the sensors of the clouds on which it acts.
pub struct CloudEffects {
    effects: EffectList,
    rig: Rig,
    reader: CloudReader,
    materials: MaterialTable,
}

impl CloudEffects {
    /// For clouds of a rig. The scan patterns are found in `some` of its clouds; [`crate::finished::pattern_frames`]
    /// says in which of a data set.
    pub fn new(effects: EffectList, rig: Rig, some: &[Cloud]) -> CloudEffects {
        let reader = CloudReader::of(&rig, some, effects.reads());
        CloudEffects { effects, rig, reader, materials: MaterialTable::default() }
    }

    /// Effects of the list that cannot be applied to clouds with so many channels. Nothing is known of motion.
    pub fn refusals(&self, channels: usize) -> Vec<Refusal> {
        refusals_of(&self.effects, &self.rig, &self.reader.known(channels, &self.effects.surfaces()))
    }

    /// A cloud with the effects applied. `index` is its number among the clouds, and its time in scans. Points that no
    /// effect touches keep their bits. The result may be empty.
    pub fn apply(&self, cloud: &Cloud, seed: u64, index: u64) -> Cloud {
        let before = self.reader.scan(cloud, &self.effects.surfaces());
        let mut scan = before.clone();
        let context = FrameContext {
            seed,
            set: STREAM,
            index,
            time_s: index as f64 * (1.0 / self.rig.sensors.first().map_or(20.0, |s| s.rate_hz)),
            rig: &self.rig,
            materials: &self.materials,
            ego_velocity: [0.0; 3],
            ego_turn_rate: [0.0; 3],
            cars: &[],
            sensors: Some(self.reader.sensors()),
            scene: None,
            world_x_rad: 0.0,
        };
        self.effects.on_cloud(&mut scan, &context);
        cloud_of(&scan, &before, cloud)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::effects::{Need, Reads};
    use crate::finished::{FinishedDataset, pattern_frames};
    use data::{Dataset, Frame, Layout};
    use std::path::Path;

    /// Walls around the sensor, 16 rows.
    fn room(shift: f32) -> Cloud {
        let mut cloud = Cloud::new(4);
        for row in 0..16 {
            for column in 0..360 {
                let (azimuth, elevation) = ((column as f32).to_radians(), (row as f32 - 8.0).to_radians());
                let range = (10.0 + shift) / azimuth.cos().abs().max(azimuth.sin().abs());
                let (x, y) = (range * azimuth.cos(), range * azimuth.sin());
                cloud.values.extend([x, y, range * elevation.tan(), 0.25 + 0.01 * row as f32]);
            }
        }
        cloud
    }

    #[test]
    fn the_bits_are_those_of_a_data_set() {
        let folder = tempfile::tempdir().unwrap();
        let clouds: Vec<Cloud> = (0..3).map(|i| room(i as f32)).collect();
        for (i, cloud) in clouds.iter().enumerate() {
            let frame = Frame { id: format!("{i:06}"), cloud: cloud.clone(), objects: Vec::new() };
            Layout::Kitti.write_frame(folder.path(), &frame).unwrap();
        }
        let text = "[[effect]]\nkind = \"range_noise\"\nstd_m = 0.02\n[[effect]]\nkind = \"random_dropout\"\nshare = 0.2\n\
                    [[effect]]\nkind = \"range_quantisation\"\nstep_m = 0.004\n";
        let list = EffectList::parse(text, Path::new("e.toml")).unwrap();
        let dataset = Dataset::open(folder.path()).unwrap();
        let finished = FinishedDataset::open(&dataset, None, &list).unwrap();
        let some: Vec<Cloud> = pattern_frames(3).map(|at| clouds[at].clone()).collect();
        let effects = CloudEffects::new(list.clone(), Rig::single(), &some);
        assert_eq!(effects.refusals(4), []);
        for (i, cloud) in clouds.iter().enumerate() {
            let want = finished.frame(&list, 7, &format!("{i:06}")).unwrap().0.cloud;
            let made = effects.apply(cloud, 7, i as u64);
            assert!(made.values.iter().map(|v| v.to_bits()).eq(want.values.iter().map(|v| v.to_bits())));
            assert!(made.len() < cloud.len());
        }
        let ghosts = EffectList::parse("[[effect]]\nkind = \"ghosts\"\nprobability = 0.1\n", Path::new("g.toml"));
        let refused = CloudEffects::new(ghosts.unwrap(), Rig::single(), &some).refusals(4);
        assert_eq!((refused.len(), refused[0].kind), (1, "ghosts"));
    }

    /// Parameters with which each effect that reads less than everything acts.
    const ACTING: &[&str] = &[
        "kind = \"range_noise\"\nstd_m = 0.02",
        "kind = \"range_noise_by_range\"\nper_m = 0.001",
        "kind = \"range_noise_by_signal\"\nstd_m = 0.01\nexponent = 0.3\nmost_m = 0.5",
        "kind = \"range_noise_by_incidence\"\ndivergence_rad = 0.003\nsamples = 4",
        "kind = \"heavy_tails\"\nprobability = 0.1\nstd_m = 0.2",
        "kind = \"range_bias\"\noffset_m = 0.03",
        "kind = \"beam_range_offset\"\nstd_m = 0.03",
        "kind = \"reflectivity_walk\"\nwalk_m = 0.02",
        "kind = \"range_quantisation\"\nstep_m = 0.01",
        "kind = \"coordinate_rounding\"\nstep_m = 0.01",
        "kind = \"range_drift\"\ndrift_m = 0.2\ntime_constant_s = 0.1",
        "kind = \"random_dropout\"\nshare = 0.2",
        "kind = \"signal_dropout\"\nthreshold = 5\nsteepness = 1",
        "kind = \"range_dropout\"\nrange_m = [5, 20]\nshare = [0.1, 0.6]",
        "kind = \"incidence_dropout\"\ncos_half = 0.5\nsteepness = 4",
        "kind = \"material_dropout\"\nsurfaces = [\"standing\"]\nshare = 0.3",
        "kind = \"range_limits\"\nmax_m = 12",
        "kind = \"ego_body_mask\"\nboxes = [[2, -3, -3, 4, 3, 3]]",
        "kind = \"dirty_window\"\nsensor = \"SENSOR\"\nradius_deg = 20\nloss = 0.8\ntransmission = 0.5",
        "kind = \"packet_loss\"\npacket_ms = 1\nloss = 0.3\nburst = 0.5",
        "kind = \"false_alarms\"\nrate = 0.05",
        "kind = \"intensity_law\"\ngain = 0.7",
        "kind = \"intensity_response\"\ngain = 2",
        "kind = \"intensity_response\"\nincidence_exponent = 0.5",
        "kind = \"beam_intensity\"\nstd = 0.3",
        "kind = \"encoder_ripple\"\namplitude_m = 0.05\nperiods = 8",
        "kind = \"point_order\"\nshuffled = true",
        "kind = \"empirical\"\ncovariate = \"row\"\nat = [0, 8]\nloss = [0.1, 0.5]",
        "kind = \"empirical\"\ncovariate = \"cos_incidence\"\nat = [0, 1]\nloss = [0.6, 0.1]",
        "kind = \"empirical\"\ncovariate = \"range_m\"\nat = [0, 30]\nloss = [0.1, 0.5]",
    ];

    /// The bits with all that a cloud tells are those with what the list reads.
    #[test]
    fn what_is_not_read_changes_no_bit() {
        let cloud = room(0.0);
        let two = "[[sensor]]\nname = \"front\"\nhorizontal_fov_deg = 180\nposition = [0.5, 0.0, 0.3]\n\
                   [[sensor]]\nname = \"rear\"\nhorizontal_fov_deg = 180\nyaw_deg = 180\n";
        let single = Rig::single();
        let mut patterned = crate::effects::testing::rig();
        patterned.sensors[0].horizontal_fov_deg = 360.0;
        for rig in [single, Rig::parse(two, Path::new("r.toml")).unwrap(), patterned] {
            let whole = |list: &EffectList| {
                let reader = CloudReader::new(&rig, std::slice::from_ref(&cloud));
                let materials = MaterialTable::default();
                CloudEffects { effects: list.clone(), rig: rig.clone(), reader, materials }
            };
            for effect in ACTING {
                let effect = effect.replace("SENSOR", &rig.sensors[0].name);
                let text = format!("intensity = \"returned_light\"\n[[effect]]\n{effect}\n");
                let list = EffectList::parse(&text, Path::new("e.toml")).unwrap();
                assert_ne!(list.reads(), Reads::ALL, "{effect}");
                let less = CloudEffects::new(list.clone(), rig.clone(), std::slice::from_ref(&cloud));
                let all = whole(&list);
                assert_eq!(less.refusals(4).len(), all.refusals(4).len(), "{effect}");
                let [less, all] = [less, all].map(|effects| effects.apply(&cloud, 7, 3));
                assert!(less.values.iter().map(|v| v.to_bits()).eq(all.values.iter().map(|v| v.to_bits())), "{effect}");
                // What needs the time of a shot does nothing without a pattern.
                assert!(all != cloud || effect.contains("packet_loss"), "{effect} does not act");
            }
        }
    }

    #[test]
    fn what_an_effect_needs_it_reads() {
        let lists = ACTING.iter().map(|effect| effect.replace("SENSOR", "front"));
        for effect in lists {
            let list = EffectList::parse(&format!("[[effect]]\n{effect}\n"), Path::new("e.toml")).unwrap();
            let (needs, reads) = (list.effects[0].model().needs().unwrap(), list.reads());
            let needs = |any: &[Need]| needs.iter().any(|need| any.contains(need));
            assert!(!needs(&[Need::Row, Need::Grid, Need::Time]) || reads.pattern, "{effect}");
            assert!(!needs(&[Need::Incidence, Need::Reflectivity]) || reads.surfaces, "{effect}");
        }
    }
}
