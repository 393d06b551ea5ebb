//! The command line program `lidarshift`. A command is a file and a line of the table below.

#[macro_use]
mod commands;
pub mod allocator;
pub mod console;
pub mod device;
pub mod errors;
pub mod json;
mod json_forms;
pub mod signals;

use clap::{CommandFactory as _, FromArgMatches as _, Parser};
use data::Place;
use errors::{ErrorFormat, ErrorReport};
use std::ffi::OsString;
use std::process::ExitCode;

pub use json_forms::json_forms;

commands! {
    /// The commands, in the order of the help.
    Command:
    Train(train::TrainArgs) "Train a detector; without options on a synthetic data set that is generated first";
    Eval(eval::EvalArgs) "Evaluate detections, data sets and studies";
    Detect(detect::DetectArgs) "Detect objects in a point cloud or in all frames of a split";
    Simulate(simulate::SimulateArgs) "Simulate data sets: a race, or streets";
    Study(study::StudyArgs) "Run a study: data sets, training runs, evaluation, report";
    #[command(hide = true)]
    StudyRun(study_run::StudyRunArgs) "Execute one run of a study";
    Compare(compare::CompareArgs) "Rank several simulations of the same recordings by their distance from measured data";
    Report(report::ReportArgs) "Write the report of a study";
    Twin(twin::TwinArgs) "Make a simulated partner of a recording that has no simulation";
    Resim(resim::ResimArgs) "Apply sensor effects to an existing data set and write the result";
    Convert(convert::ConvertArgs) "Write a data set in the format of KITTI, OpenPCDet, CARLA, PCD or MCAP (ROS 2)";
    Export(export::ExportArgs) "Write a sensor model as files of CARLA, Isaac Sim, Gazebo, RGL or HELIOS++, or a detector as ONNX";
    Diagnose(diagnose::DiagnoseArgs) "Find the differences between measured and simulated data and their causes";
    Doctor(doctor::DoctorArgs) "Check a data set for errors";
    Completions(completions::CompletionsArgs) "Print the completions of a shell";
    Man(man::ManArgs) "Write the pages of the manual";
}

/// How much does a LiDAR detector trained in simulation lose on real data, why, and what must change in the simulator?
#[derive(Parser, Debug)]
#[command(name = "lidarshift", version, about, arg_required_else_help = true)]
struct Program {
    /// Form of an error on stderr; json: one object, the last line, with code, kind, file, line, hint and message
    #[arg(long, global = true, value_enum, value_name = "FORMAT", default_value = "text")]
    errors: ErrorFormat,
    #[command(subcommand)]
    command: Command,
}

/// Exit code of a command that failed.
const FAILURE: u8 = 1;

/// The command line with all commands and options.
pub fn command() -> clap::Command {
    Program::command()
}

/// Runs the command line. Exit codes: 0 success, 1 failure, 2 wrong arguments, 3 a diagnosis of data sets that do not
/// show the same scenes. The program ends by SIGINT or SIGTERM if it was stopped, and by SIGPIPE if stdout was closed.
pub fn run() -> ExitCode {
    ExitCode::from(run_with(std::env::args_os().collect()))
}

/// The features of cargo that this program was built with, those that change what a device computes.
pub const FEATURES: &[&str] = &[
    #[cfg(feature = "wgpu")]
    "wgpu",
    #[cfg(feature = "vulkan")]
    "vulkan",
    #[cfg(feature = "cuda")]
    "cuda",
    #[cfg(feature = "fusion")]
    "fusion",
    #[cfg(feature = "autotune")]
    "autotune",
];

/// Names the build of this program, for its results: the commit of the checkout that it was built from, if there was
/// one, and [`FEATURES`]. [`run_with`] does so as well.
pub fn name_build() {
    data::set_features(FEATURES);
    if let Some(commit) = option_env!("LIDARSHIFT_COMMIT").filter(|commit| !commit.is_empty()) {
        data::set_commit(commit);
    }
}

fn parse(arguments: &[OsString]) -> Result<Program, clap::Error> {
    let mut command = command();
    // The build may be named by a hash of the program, which takes time.
    if arguments.get(1).is_some_and(|first| first == "--version" || first == "-V") {
        command = command.version(data::build_id());
    }
    let matches = command.try_get_matches_from_mut(arguments)?;
    if json::is_on_stdout(&matches) {
        console::text_to_stderr();
    }
    Program::from_arg_matches(&matches).map_err(|error| error.format(&mut command))
}

/// As [`run`] with these arguments, of which the first is the name of the program; returns the exit code. For programs
/// in which this one is contained: it handles signals from then on, and it is called once.
pub fn run_with(arguments: Vec<OsString>) -> u8 {
    commands::set_called(&arguments);
    name_build();
    signals::handle();
    let is_json = ErrorFormat::of(&arguments) == ErrorFormat::Json;
    let (code, report) = match parse(&arguments).map(|program| program.command.run()) {
        Ok(Ok(end)) => (end.into(), ErrorReport::of_end(end)),
        Ok(Err(error)) => {
            if !is_json {
                errln!("error: {error:#}");
            }
            (FAILURE, Some(ErrorReport::of_error(&error)))
        }
        Err(usage) => match ErrorReport::of_usage(&usage).filter(|_| is_json) {
            Some(report) => (report.code, Some(report)),
            None => (console::print_usage(&usage, &arguments), None),
        },
    };
    if let Some(report) = report.as_ref().filter(|_| is_json) {
        report.print();
    }
    if code == FAILURE {
        signals::end_if_stopped();
    }
    if !is_json {
        return console::end(code);
    }
    let Some(error) = console::lost_stdout() else { return code };
    if report.is_none() {
        let place = Place::of_kind(error.kind().into());
        ErrorReport::new(FAILURE, place, format!("stdout cannot be written: {error}")).print();
    }
    FAILURE
}
