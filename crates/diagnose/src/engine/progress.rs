//! How far a diagnosis is.

/// Stages, for the display of progress.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Estimating scan patterns and comparing scenes.
    Comparing,
    /// Pairing frames.
    Pairing,
    /// Comparing hypotheses.
    Weighing,
    /// Making frames anew with what was found.
    Verifying,
}

/// Called with the stage, how much of it is finished and how much there is.
pub type Progress<'a> = &'a (dyn Fn(Stage, usize, usize) + Sync);
