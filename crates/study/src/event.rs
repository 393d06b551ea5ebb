//! Progress events of a study.

/// A progress event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event<'a> {
    /// A sentence about the progress.
    Note(&'a str),
    /// A line of the result.
    Result(&'a str),
    /// A number of frames of a data set is finished.
    Frames {
        /// Name of the data set.
        dataset: &'a str,
        /// Number of finished frames.
        done: usize,
        /// Number of all frames.
        total: usize,
    },
    /// A data set is finished.
    DatasetMade,
}

/// Receives the events.
pub type Listener<'a> = &'a (dyn Fn(Event<'_>) + Sync);
