//! `lidarshift diagnose --simulator CONFIG`: frames of the simulation made anew by the simulator itself.

use anyhow::{Context, Result, bail};
use data::{Cloud, DataError, Dataset, Object};
use diagnose::{DiagnoseError, RemadeFrames, Remake, SEEDS};
use sensor::EffectList;
use sensor::finished::Refusal;
use simulate::SimulateError;
use simulate::race::{PreparedSet, RaceConfig, RaceManifest, Simulator};
use std::path::Path;

/// The simulation that made a data set.
pub(super) struct RaceSimulator {
    simulator: Simulator,
    /// Name of the data set in the configuration, its effects, and how its labels are made.
    set: String,
    lists: Vec<(String, EffectList)>,
    auto_label: Option<simulate::auto_label::AutoLabel>,
}

impl RaceSimulator {
    /// The simulation `named` that made the data set `simulated`, with the seed and the number of frames of its
    /// manifest.
    ///
    /// # Errors
    /// A configuration that cannot be read, and one that does not make these frames.
    pub(super) fn open(named: &str, simulated: &Dataset) -> Result<RaceSimulator> {
        let (mut race, files) = RaceConfig::find(named)?;
        let root = &simulated.config.root;
        let manifest = root.join("manifest.json");
        let text = fs_err::read_to_string(&manifest)
            .with_context(|| format!("{} was not made by `lidarshift simulate`: it has no manifest", root.display()))?;
        let made: RaceManifest = serde_json::from_str(&text)
            .map_err(|e| DataError::line(&manifest, e.line(), format!("is not the manifest of a race: {e}")))?;
        let [_, name] = &made.name;
        let Some(set) = race.datasets.iter().find(|set| set.name == *name).cloned() else {
            bail!("{named} has no data set {name:?}, which {} is", root.display());
        };
        let ids = simulated.all_ids()?;
        (race.seed, race.frames) = (made.seed, ids.len());
        let lists = race.effects_of(&set, &files)?;
        let simulator = Simulator::new(race, &files)?;
        let again = RaceSimulator { simulator, set: set.name.clone(), lists, auto_label: set.auto_label };
        let id = &ids[0];
        let cloud = again.frame_of(&again.prepared(None, 0), id)?.0;
        if cloud.values != simulated.load_cloud(id)?.values {
            bail!(
                "{named} does not make the frame {id} of {} anew: give the configuration, and the version of this program, \
                 that made it; or leave out --simulator, and the finished clouds are changed",
                root.display()
            );
        }
        Ok(again)
    }

    fn prepared(&self, effects: Option<&EffectList>, seed: u64) -> PreparedSet {
        let more = effects.map(|list| (format!("{}/extended {seed}", self.set), list.clone()));
        self.simulator.prepare(self.lists.iter().cloned().chain(more).collect(), self.auto_label)
    }

    fn frame_of(&self, set: &PreparedSet, id: &str) -> Result<(Cloud, Vec<Object>), DiagnoseError> {
        let key = self.simulator.key(id).ok_or_else(|| DataError::file(Path::new(id), "is no frame of the race"))?;
        let made = self.simulator.make(set, key).map_err(|error| match error {
            SimulateError::Data(error) => DiagnoseError::Data(error),
            other => DiagnoseError::Pair(other.to_string()),
        })?;
        Ok((made.frame.cloud, made.frame.objects))
    }
}

impl Remake for RaceSimulator {
    fn with<'s>(&'s self, effects: &EffectList) -> Result<(Box<dyn RemadeFrames + 's>, Vec<Refusal>), DiagnoseError> {
        let refused = effects.effects.iter().enumerate().filter_map(|(index, effect)| {
            let why = effect.strange_to(&self.simulator.rig)?;
            Some(Refusal { index, kind: effect.kind(), why })
        });
        let refused: Vec<Refusal> = refused.collect();
        let applied = effects.without(&refused);
        let draws = SEEDS.map(|seed| self.prepared(Some(&applied), seed));
        Ok((Box::new(Extended { simulator: self, draws }), refused))
    }
}

/// The simulation with effects, for two random seeds.
struct Extended<'a> {
    simulator: &'a RaceSimulator,
    draws: [PreparedSet; 2],
}

impl RemadeFrames for Extended<'_> {
    fn frame(&self, id: &str) -> Result<[(Cloud, Vec<Object>); 2], DiagnoseError> {
        let [one, other] = &self.draws;
        Ok([self.simulator.frame_of(one, id)?, self.simulator.frame_of(other, id)?])
    }

    fn frame_with(&self, effects: &EffectList, id: &str) -> Result<(Cloud, Vec<Object>), DiagnoseError> {
        self.simulator.frame_of(&self.simulator.prepared(Some(effects), SEEDS[0]), id)
    }
}
