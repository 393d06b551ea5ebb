//! The sensor model as files of other simulators. [`export()`] turns a list of effects and a rig into the files of a
//! program, a list of what the program cannot express, and a script that applies the rest to its finished clouds.
//!
//! The file formats were read in the sources and the documentation of the programs. Each module names them.

mod carla;
mod fit;
mod frames;
mod gazebo;
mod helios;
mod isaac;
mod loss;
mod number;
mod pattern;
mod placement;
mod plan;
mod post_process;
mod program;
mod rgl;
mod scenario;

pub use fit::{DropOff, FIT_RANGES_M, fit_drop_off};
pub use loss::RangeLoss;
pub use placement::{Expressed, FitError, NotExpressed, Remedy};
pub use program::Program;

use data::output::write_atomic;
use data::{DataError, JsonForm, write_json};
use placement::Placed;
use schemars::JsonSchema;
use sensor::{EffectList, Rig};
use serde::Serialize;
use std::path::Path;

/// Name of the list of what is not expressed.
pub const NOT_EXPRESSED: &str = "not_expressed.json";

/// A sensor model in the form of a program.
#[derive(Clone, Debug, PartialEq)]
pub struct Export {
    /// The files, by name.
    pub files: Vec<(String, String)>,
    /// What was expressed and what was not.
    pub summary: Summary,
}

/// Version of [`Summary`].
const SUMMARY_SCHEMA: &str = "lidarshift/not-expressed/1";

/// What an export expresses, for `not_expressed.json`.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Summary {
    /// Name and version of the form of this file.
    pub schema: &'static str,
    /// The program.
    pub program: &'static str,
    /// What the program's own parameters express.
    pub expressed: Vec<Expressed>,
    /// What they do not express, in the order of the list.
    pub not_expressed: Vec<NotExpressed>,
    /// Laws that were fitted, with their remaining errors.
    pub fits: Vec<FitError>,
    /// What has to be known to use the files.
    pub notes: Vec<String>,
}

/// The files of a program for a sensor model. `model` and `rig_name` name the sources in the comments of the files. The
/// list must have been checked ([`EffectList::read`] does it).
pub fn export(program: Program, list: &EffectList, rig: &Rig, model: &str, rig_name: Option<&str>) -> Export {
    let Placed { plan, expressed, mut not_expressed, remaining } = placement::place(program, list, rig);
    let head = frames::Head { program, model: model.into(), rig: rig_name.map(str::to_owned) };
    let made = match program {
        Program::Carla => carla::files(&head, &plan),
        Program::Isaac => isaac::files(&head, &plan),
        Program::Gazebo => gazebo::files(&head, &plan),
        Program::Rgl => rgl::files(&head, &plan),
        Program::Helios => helios::files(&head, &plan),
    };
    not_expressed.extend(made.not_expressed);
    let mut files = made.files;
    files.extend(post_process::files(&head, &remaining));
    let summary = Summary {
        schema: SUMMARY_SCHEMA,
        program: program.name(),
        expressed,
        not_expressed,
        fits: made.fits,
        notes: made.notes,
    };
    Export { files, summary }
}

impl Export {
    /// Writes the files and `not_expressed.json` into a folder, which is made if it does not exist.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), DataError> {
        for (name, text) in &self.files {
            write_atomic(&folder.join(name), text.as_bytes())?;
        }
        write_json(&folder.join(NOT_EXPRESSED), &self.summary)
    }
}

/// The forms of the JSON files of this crate. Those for other programs have the forms of those programs.
pub fn json_forms() -> Vec<JsonForm> {
    vec![JsonForm::of::<Summary>(
        "not-expressed",
        "`not_expressed.json` of `export`, `export --json`",
        Some(SUMMARY_SCHEMA),
    )]
}
