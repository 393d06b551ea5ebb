//! The program `lidarshift`: detectors trained in simulation, measured on the road. A file a command.

pub mod bench_step;
pub mod detect;
pub mod device;
pub mod diagnose;
pub mod doctor;
pub mod eval_ap;
pub mod eval_distances;
pub mod eval_matrix;
pub mod eval_statistics;
pub mod eval_targets;
pub mod eval_tsne;
pub mod fuzz;
pub mod memory;
pub mod parity;
pub mod report_command;
pub mod resim;
pub mod schema;
pub mod simulate;
pub mod study;
pub mod train;

use clap::{Parser, Subcommand};
use std::process::ExitCode;

/// What will my detector, trained in simulation, lose on the road; why; and what must change in the simulator?
#[derive(Parser, Debug)]
#[command(name = "lidarshift", version, about, arg_required_else_help = true)]
struct Program {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand, Debug)]
enum Command {
    /// Train a detector; without options on data made on the spot
    Train(train::TrainArgs),
    /// Numbers of detections
    Eval {
        #[command(subcommand)]
        command: Eval,
    },
    /// Boxes in a cloud, or in a whole split of a data set
    Detect(detect::DetectArgs),
    /// Make synthetic data sets: a race, or streets
    Simulate(simulate::SimulateArgs),
    /// A whole study: data sets, runs, matrix, report
    Study(study::StudyArgs),
    /// One run of a study
    #[command(hide = true)]
    StudyRun(study::work::StudyRunArgs),
    /// The page of a study
    Report(report_command::ReportArgs),
    /// Make a data set from another one with physical effects on top
    Resim(resim::ResimArgs),
    /// What a simulation gets wrong against measured data, why, and what mending it gains
    Diagnose(diagnose::DiagnoseArgs),
    /// What is wrong with a data set, in words
    Doctor(doctor::DoctorArgs),
    /// Compare every tensor with a folder of reference numbers
    Parity(parity::ParityArgs),
    /// Write the JSON schema and the reference of the configuration files
    #[command(hide = true)]
    Schema(schema::SchemaArgs),
    /// Feed damaged files to every reader
    #[command(hide = true)]
    Fuzz(fuzz::FuzzArgs),
    /// Time a training step by stage
    #[command(hide = true)]
    BenchStep(bench_step::BenchStepArgs),
}

#[derive(Subcommand, Debug)]
enum Eval {
    /// Average precision and recall of detections in KITTI text
    Ap(eval_ap::EvalApArgs),
    /// Points and boxes of two data sets of the same frames
    Statistics(eval_statistics::EvalStatisticsArgs),
    /// Train set x test set of a study
    Matrix(eval_matrix::EvalMatrixArgs),
    /// How far the clouds of two data sets are from each other
    Distances(eval_distances::EvalDistancesArgs),
    /// Targets of data sets
    Targets(eval_targets::EvalTargetsArgs),
    /// What the networks of a study see
    Tsne(eval_tsne::EvalTsneArgs),
}

impl Eval {
    fn run(self) -> anyhow::Result<()> {
        match self {
            Eval::Ap(args) => args.run(),
            Eval::Statistics(args) => args.run(),
            Eval::Matrix(args) => args.run(),
            Eval::Distances(args) => args.run(),
            Eval::Targets(args) => args.run(),
            Eval::Tsne(args) => args.run(),
        }
    }
}

/// Exit code of a diagnosis whose two sides do not show the same scenes.
const NOT_THE_SAME_SCENES: u8 = 3;

/// Runs the command line. 0 when all of it worked, 1 when it did not, 2 when it could not be understood; a diagnosis has a code of its own.
pub fn run() -> ExitCode {
    let done = match Program::parse().command {
        Command::Train(args) => args.run().map(|()| true),
        Command::Eval { command } => command.run().map(|()| true),
        Command::Report(args) => args.run().map(|()| true),
        Command::Detect(args) => args.run().map(|()| true),
        Command::Simulate(args) => args.run().map(|()| true),
        Command::Study(args) => args.run().map(|()| true),
        Command::StudyRun(args) => args.run().map(|()| true),
        Command::Resim(args) => args.run().map(|()| true),
        Command::Diagnose(args) => match args.run() {
            Ok(false) => return ExitCode::from(NOT_THE_SAME_SCENES),
            done => done,
        },
        Command::Doctor(args) => args.run(),
        Command::Parity(args) => args.run(),
        Command::Schema(args) => args.run().map(|()| true),
        Command::Fuzz(args) => args.run(),
        Command::BenchStep(args) => args.run().map(|()| true),
    };
    match done {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
