//! `lidarshift eval`: metrics of detections, point clouds, targets and features.

use crate::commands::End;
use anyhow::Result;
use clap::Args;

commands! {
    /// The evaluations, in the order of the help.
    EvalCommand:
    Ap(ap::EvalApArgs) "Average precision and recall of detections in KITTI text or of OpenPCDet";
    Statistics(statistics::EvalStatisticsArgs) "Points and boxes of two data sets with the same frames";
    Matrix(matrix::EvalMatrixArgs) "Matrix of a study: AP and recall by train set and test set";
    Distances(distances::EvalDistancesArgs) "Distances between the point clouds of two data sets";
    Targets(targets::EvalTargetsArgs) "Number, position and points of the labelled targets of data sets";
    Tsne(tsne::EvalTsneArgs) "Features of the networks of a study: t-SNE, CKA, Fréchet distance";
}

/// Evaluate detections, data sets and studies
#[derive(Args, Debug)]
pub struct EvalArgs {
    #[command(subcommand)]
    command: EvalCommand,
}

impl EvalArgs {
    /// Runs the chosen evaluation.
    ///
    /// # Errors
    /// As the chosen command.
    pub fn run(self) -> Result<End> {
        self.command.run()
    }
}
