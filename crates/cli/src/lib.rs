//! The program `lidarshift`: detectors trained in simulation, measured on the road. A command is a file and a line of the table.

#[macro_use]
mod commands;
pub mod allocator;
pub mod device;

use clap::Parser;
use std::process::ExitCode;

commands! {
    /// The commands, in the order of the help.
    Command:
    Train(train::TrainArgs) "Train a detector; without options on data made on the spot";
    Eval(eval::EvalArgs) "Numbers of detections";
    Detect(detect::DetectArgs) "Boxes in a cloud, or in a whole split of a data set";
    Simulate(simulate::SimulateArgs) "Make synthetic data sets: a race, or streets";
    Study(study::StudyArgs) "A whole study: data sets, runs, matrix, report";
    #[command(hide = true)]
    StudyRun(study_run::StudyRunArgs) "One run of a study";
    Report(report::ReportArgs) "The page of a study";
    Resim(resim::ResimArgs) "Make a data set from another one with physical effects on top";
    Diagnose(diagnose::DiagnoseArgs) "What a simulation gets wrong against measured data, why, and what mending it gains";
    Doctor(doctor::DoctorArgs) "What is wrong with a data set, in words";
}

/// What will my detector, trained in simulation, lose on the road; why; and what must change in the simulator?
#[derive(Parser, Debug)]
#[command(name = "lidarshift", version, about, arg_required_else_help = true)]
struct Program {
    #[command(subcommand)]
    command: Command,
}

/// Runs the command line. 0 when all of it worked, 1 when it did not, 2 when it could not be understood; a diagnosis has a code of its own.
pub fn run() -> ExitCode {
    match Program::parse().command.run() {
        Ok(end) => end.into(),
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
