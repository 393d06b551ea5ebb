//! `cargo xtask parity DIR`: compares this program with reference values of OpenPCDet and PyTorch, tensor by tensor.

mod bev;
mod manifest;
mod network;
mod operators;
mod point_operators;
mod recipe;
mod reference;
mod rotations;
mod toy_training;

/// Declares the module of each detector and the table of their comparisons.
macro_rules! detectors {
    ($($file:ident),+ $(,)?) => {
        $(mod $file;)+

        /// The comparisons of all detectors.
        const DETECTORS: &[network::DetectorChecks] = &[$($file::CHECKS),+];
    };
}

detectors!(pointpillars, pointrcnn, centerpoint);

use anyhow::{Context, Result};
use clap::Args;
use lidarshift::device::DeviceArgs;
use lidarshift::outln;
use reference::Row;
use schemars::JsonSchema;
use serde::Serialize;
use std::path::PathBuf;

/// Compare all tensors of a network, or of single operations, with reference values.
///
/// Example: cargo xtask parity ../shared/golden/pointpillars_tiny
#[derive(Args, Debug)]
pub struct ParityArgs {
    /// Folder with manifest.json and the safetensors files of a network or of single operations
    dir: PathBuf,
    #[command(flatten)]
    device: DeviceArgs,
    /// Also write the rows as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Print every row, not only failures and the row closest to its tolerance in each file
    #[arg(long)]
    all: bool,
}

#[derive(Serialize, JsonSchema)]
struct Parity<'a> {
    schema: &'static str,
    rows: &'a [Row],
}

impl ParityArgs {
    /// Compares and prints; `true` if every tensor passes.
    pub fn run(self) -> Result<bool> {
        let device = self.device.open()?;
        let folder = fs_err::canonicalize(&self.dir)?;
        let manifest = fs_err::read_to_string(folder.join("manifest.json"))
            .context("a folder with reference values needs a manifest.json")?;
        let manifest: serde_json::Value = serde_json::from_str(&manifest).context("manifest.json is not JSON")?;
        let rows = match manifest.get("model_cfg") {
            Some(_) => network::compare(&folder, &device)?,
            None => operators::compare(&folder, &device)?,
        };
        if let Some(path) = &self.json {
            let parity = Parity { schema: "lidarshift/parity/1", rows: &rows };
            data::write_json(path, &parity)?;
        }
        outln!("{:<24} {:<44} {:>10} {:>10}  ", "file", "tensor", "error", "tolerance");
        for row in rows.iter().filter(|r| self.all || !r.pass || is_largest(r, &rows)) {
            let error = row.error.map_or("none".into(), |e| format!("{e:.1e}"));
            let verdict = if row.pass { "pass" } else { "FAIL" };
            outln!("{:<24} {:<44} {error:>10} {:>10.1e}  {verdict}", row.file, row.tensor, row.tolerance);
        }
        let failed = rows.iter().filter(|r| !r.pass).count();
        outln!("{} tensors compared, {} pass, {failed} fail", rows.len(), rows.len() - failed);
        Ok(failed == 0 && !rows.is_empty())
    }
}

/// Whether a row is the closest to its tolerance in its file.
fn is_largest(row: &Row, rows: &[Row]) -> bool {
    let share = |r: &Row| r.error.unwrap_or(0.0) / r.tolerance.max(f64::MIN_POSITIVE);
    rows.iter().filter(|r| r.file == row.file).all(|r| share(r) <= share(row)) && share(row) > 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn passes(folder: &str) -> bool {
        let dir = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden")).join(folder);
        ParityArgs { dir, device: DeviceArgs::default(), json: None, all: false }.run().unwrap()
    }

    #[test]
    fn operations_and_small_networks_equal_the_reference() {
        for folder in
            ["operators", "synthetic/pointpillars_tiny", "synthetic/pointrcnn_tiny", "synthetic/centerpoint_tiny"]
        {
            assert!(passes(folder), "{folder}");
        }
    }
}
