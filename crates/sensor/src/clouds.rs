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
        let reader = CloudReader::new(&rig, some);
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
}
