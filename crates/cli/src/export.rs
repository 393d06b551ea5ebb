//! `lidarshift export`: the sensor model as files of other simulators, and a detector as ONNX graphs.

mod onnx;

pub(crate) use onnx::{ONNX_SCHEMA, OnnxDescription};

use crate::json::JsonArgs;
use crate::{errln, outln};
use anyhow::Result;
use clap::{Args, ValueEnum};
use data::DataError;
use exchange::{NOT_EXPRESSED, Program, Remedy};
use sensor::{EffectList, Rig};
use std::path::PathBuf;

/// Write a sensor model as files of another simulator, or a detector as ONNX graphs.
///
/// Units and frames are converted. What the simulator cannot express is printed, written to not_expressed.json, and
/// applied to its finished clouds by post_process.py.
///
/// Examples:
///   lidarshift export --to carla diagnosis/extended.toml --rig configs/sensors/hdl64e.toml --out carla
///   lidarshift export --to helios my-effects.toml --out helios
///   lidarshift export --to onnx runs/mine --check my-data/velodyne/000000.bin --out onnx
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct ExportArgs {
    /// TOML with the list of effects, for example extended.toml of a diagnosis; for onnx the folder of a run or weights
    #[arg(value_name = "MODEL")]
    model: PathBuf,
    /// The simulator, or onnx
    #[arg(long, value_name = "PROGRAM")]
    to: Target,
    /// TOML with poses and patterns of the sensors [default: one sensor at the origin of the clouds, without a pattern]
    #[arg(long, alias = "sensor", value_name = "TOML")]
    rig: Option<PathBuf>,
    /// onnx: detector of the weights, a name or a TOML [default: from config.toml of the run that wrote the weights]
    #[arg(long, value_name = "NAME|TOML")]
    detector: Option<String>,
    /// onnx: cloud whose inputs and outputs are written to check.safetensors, for the comparison by run_onnx.py --check
    #[arg(long, value_name = "CLOUD")]
    check: Option<PathBuf>,
    /// Folder for the files
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    json: JsonArgs,
}

/// The simulators, as words of the command line.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Target {
    /// CARLA: sensor.lidar.ray_cast
    Carla,
    /// NVIDIA Isaac Sim: RTX LiDAR
    Isaac,
    /// Gazebo: gpu_lidar in SDF
    Gazebo,
    /// Robotec GPU LiDAR (AWSIM): C++ for its C API
    Rgl,
    /// HELIOS++: scanner and platform XML
    Helios,
    /// ONNX: PointPillars and CenterPoint as two graphs
    Onnx,
}

impl ExportArgs {
    /// Writes the files and prints what they do not express.
    pub fn run(self) -> Result<()> {
        let network_only = [("--detector", self.detector.is_some()), ("--check", self.check.is_some())];
        let program = match self.to {
            Target::Carla => Program::Carla,
            Target::Isaac => Program::Isaac,
            Target::Gazebo => Program::Gazebo,
            Target::Rgl => Program::Rgl,
            Target::Helios => Program::Helios,
            Target::Onnx => {
                if self.rig.is_some() {
                    anyhow::bail!("--rig is for sensor models, not for --to onnx; leave it out");
                }
                let Self { model, detector, check, out, json, .. } = self;
                return onnx::OnnxExport { weights: model, detector, check, out, json }.run();
            }
        };
        if let Some((option, _)) = network_only.iter().find(|(_, given)| *given) {
            anyhow::bail!("{option} is for --to onnx; leave it out");
        }
        self.json.check([&*self.model].into_iter().chain(self.rig.as_deref()))?;
        let list = EffectList::read(&self.model)?;
        let rig = self.rig.as_deref().map_or(Ok(Rig::single()), Rig::read)?;
        if let Some(why) = list.effects.iter().find_map(|e| Some(format!("{} {}", e.kind(), e.strange_to(&rig)?))) {
            return Err(DataError::file(&self.model, why).into());
        }
        let rig_name = self.rig.as_ref().map(|path| path.display().to_string());
        let export = exchange::export(program, &list, &rig, &self.model.display().to_string(), rig_name.as_deref());
        export.write(&self.out)?;
        self.json.write(&export.summary)?;
        for e in &export.summary.expressed {
            outln!("effect[{}]: {}: {}", e.index, e.kind, e.by);
        }
        for e in &export.summary.not_expressed {
            let place = e.index.map_or(String::new(), |i| format!("effect[{i}]: "));
            let remedy = match &e.remedy {
                Remedy::PostProcess { .. } => "applied by post_process.py",
                Remedy::Scenario { change } => change,
                Remedy::Approximated { how } => how,
            };
            outln!("not expressed: {place}{}: {}; {remedy}", e.kind, e.why);
        }
        for fit in &export.summary.fits {
            let [near, far] = fit.range_m;
            outln!("fit: {}: largest error {:.4}, rms {:.4} ({near} to {far} m)", fit.what, fit.largest, fit.rms);
        }
        let names: Vec<&str> = export.files.iter().map(|(name, _)| name.as_str()).collect();
        errln!("written to {}: {}, {NOT_EXPRESSED}", self.out.display(), names.join(", "));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_for_another_rig_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let (model, out) = (folder.path().join("m.toml"), folder.path().join("out"));
        let args = |to| ExportArgs {
            model: model.clone(),
            to,
            rig: None,
            detector: None,
            check: None,
            out: out.clone(),
            json: JsonArgs::default(),
        };
        std::fs::write(&model, "[[effect]]\nkind = \"sensor_pose_error\"\nsensor = \"front\"\n").unwrap();
        let error = args(Target::Carla).run().unwrap_err().to_string();
        assert!(error.contains("m.toml") && error.contains("\"front\""), "{error}");
        std::fs::write(&model, "[[effect]]\nkind = \"heavy_tails\"\nprobability = 0.1\nstd_m = 0.1\n").unwrap();
        for to in [Target::Carla, Target::Isaac, Target::Gazebo, Target::Rgl, Target::Helios] {
            args(to).run().unwrap();
            assert!(out.join(NOT_EXPRESSED).is_file() && out.join("post_process.py").is_file());
        }
    }
}
