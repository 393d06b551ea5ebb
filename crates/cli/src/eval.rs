//! `lidarshift eval`: numbers of detections, clouds and features.

use crate::commands::End;
use anyhow::Result;
use clap::Args;

commands! {
    /// What can be evaluated, in the order of the help.
    EvalCommand:
    Ap(ap::EvalApArgs) "Average precision and recall of detections in KITTI text";
    Statistics(statistics::EvalStatisticsArgs) "Points and boxes of two data sets of the same frames";
    Matrix(matrix::EvalMatrixArgs) "Train set x test set of a study";
    Distances(distances::EvalDistancesArgs) "How far the clouds of two data sets are from each other";
    Targets(targets::EvalTargetsArgs) "Targets of data sets";
    Tsne(tsne::EvalTsneArgs) "What the networks of a study see";
}

/// Numbers of detections
#[derive(Args, Debug)]
pub struct EvalArgs {
    #[command(subcommand)]
    command: EvalCommand,
}

impl EvalArgs {
    /// Evaluates what was asked for.
    ///
    /// # Errors
    /// As the command that was named.
    pub fn run(self) -> Result<End> {
        self.command.run()
    }
}
