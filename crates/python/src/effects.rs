//! The sensor model on clouds in memory.

use crate::arrays::{array_of, cloud_of};
use crate::errors::{raised, with_place};
use data::Cloud;
use pyo3::prelude::*;
use pyo3::types::PyByteArray;
use sensor::clouds::CloudEffects;
use sensor::finished::pattern_frames;
use sensor::{EffectList, Rig};
use std::path::PathBuf;

/// A list of effects for clouds of a rig.
#[pyclass(frozen, module = "lidarshift._native")]
pub struct Effects {
    list: EffectList,
    model: PathBuf,
    rig: Rig,
    /// With the scan patterns of given clouds. Without them, those of each cloud are found in itself.
    found: Option<CloudEffects>,
}

#[pymethods]
impl Effects {
    /// `model` and `rig` are paths of TOML files.
    #[new]
    fn new(
        py: Python<'_>,
        model: PathBuf,
        rig: Option<PathBuf>,
        clouds: Option<Vec<(Vec<u8>, usize)>>,
    ) -> PyResult<Self> {
        let list = EffectList::read(&model).map_err(|e| raised(py, e))?;
        let rig = rig.as_deref().map_or(Ok(Rig::single()), Rig::read).map_err(|e| raised(py, e))?;
        let found = match clouds {
            None => None,
            Some(clouds) => {
                let clouds: Vec<Cloud> =
                    clouds.iter().map(|(bytes, channels)| cloud_of(py, bytes, *channels)).collect::<PyResult<_>>()?;
                Some(py.detach(|| CloudEffects::new(list.clone(), rig.clone(), &clouds)))
            }
        };
        Ok(Effects { list, model, rig, found })
    }

    /// The cloud with the effects applied.
    fn apply<'py>(
        &self,
        py: Python<'py>,
        points: &[u8],
        channels: usize,
        seed: u64,
        frame: u64,
    ) -> PyResult<(Bound<'py, PyByteArray>, usize)> {
        let cloud = cloud_of(py, points, channels)?;
        let made = py.detach(|| {
            let own;
            let effects = match &self.found {
                Some(found) => found,
                None => {
                    own = CloudEffects::new(self.list.clone(), self.rig.clone(), std::slice::from_ref(&cloud));
                    &own
                }
            };
            if let Some(refusal) = effects.refusals(cloud.channels).into_iter().next() {
                return Err(format!("effect[{}]: {} {}", refusal.index, refusal.kind, refusal.why));
            }
            Ok(effects.apply(&cloud, seed, frame))
        });
        match made {
            Ok(cloud) => Ok(array_of(py, &cloud)),
            Err(why) => {
                let text = format!("{}: {why}", self.model.display());
                Err(with_place(py, &text, Some(self.model.clone())))
            }
        }
    }

    /// Which of so many frames of a data set tell its scan patterns.
    #[staticmethod]
    fn pattern_frames(frames: usize) -> Vec<usize> {
        pattern_frames(frames).collect()
    }
}
