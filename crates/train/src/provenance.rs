//! `provenance.json`: program, data and machine of a run.

use crate::{RunConfig, TrainError};
use data::checksum::file_sha256;
use data::{build_id, features, program_sha256, write_json};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

/// Version of `provenance.json`.
pub const PROVENANCE_SCHEMA: &str = "lidarshift/provenance/1";

/// Program, data and machine of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// [`PROVENANCE_SCHEMA`].
    pub schema: String,
    /// SHA-256 of the configuration.
    pub config_sha256: String,
    /// The data set.
    pub dataset: DatasetProvenance,
    /// SHA-256 of the initial checkpoint.
    pub init_sha256: Option<String>,
    /// The processes that trained the run, in order.
    pub sessions: Vec<SessionProvenance>,
}

/// The training data of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DatasetProvenance {
    /// Its name.
    pub name: String,
    /// Its folder.
    pub root: String,
    /// Number of training frames.
    pub frames: usize,
    /// SHA-256 of their ids.
    pub frames_sha256: String,
}

/// One process that trained a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SessionProvenance {
    /// Number of steps before it.
    pub from_step: u64,
    /// Start time, s since 1970.
    pub began_unix_s: u64,
    /// Its command line.
    pub command: Vec<String>,
    /// Build of the program: [`data::build_id`].
    pub version: String,
    /// Features of cargo that the program was built with: [`data::features`]. Earlier versions have none.
    #[serde(default)]
    pub features: Vec<String>,
    /// SHA-256 of the program's file.
    pub program_sha256: Option<String>,
    /// Operating system and architecture.
    pub system: String,
    /// Model of the processor, if known.
    pub processor: Option<String>,
    /// Logical processors.
    pub threads: usize,
    /// Compute device.
    pub device: String,
    /// Number of loader threads.
    pub workers: usize,
}

impl SessionProvenance {
    /// The entry of this process.
    pub fn now(from_step: u64, device: &str, workers: usize) -> Self {
        let cpu = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        let model = cpu.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
        SessionProvenance {
            from_step,
            began_unix_s: SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |t| t.as_secs()),
            command: std::env::args_os().map(|argument| argument.to_string_lossy().into_owned()).collect(),
            version: build_id().into(),
            features: features().iter().map(|feature| feature.to_string()).collect(),
            program_sha256: program_sha256().map(String::from),
            system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
            processor: model.map(|(_, name)| name.trim().into()),
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            device: device.into(),
            workers,
        }
    }
}

/// Appends a session to the file and creates the file if needed.
pub(crate) fn record_session(
    path: &Path,
    config: &RunConfig,
    dataset: DatasetProvenance,
    session: SessionProvenance,
) -> Result<(), TrainError> {
    let mut provenance = match fs_err::read(path) {
        Ok(bytes) => serde_json::from_slice(&bytes).map_err(|e| {
            TrainError::folder(path, format!("is damaged ({e}); remove it, the run can go on without it"))
        })?,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Provenance {
            schema: PROVENANCE_SCHEMA.into(),
            config_sha256: config.sha256(),
            dataset,
            init_sha256: config.init.as_deref().map(file_sha256).transpose()?,
            sessions: Vec::new(),
        },
        Err(e) => return Err(e.into()),
    };
    provenance.sessions.push(session);
    Ok(write_json(path, &provenance)?)
}
