//! What a study says while it works.

/// One thing that happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event<'a> {
    /// A sentence about the progress.
    Note(&'a str),
    /// A line of the result.
    Result(&'a str),
    /// So many frames of a data set are made.
    Frames {
        /// Name of the data set.
        dataset: &'a str,
        /// Frames that are there.
        done: usize,
        /// Frames of the whole.
        total: usize,
    },
    /// A data set is whole.
    DatasetMade,
}

/// Who is told what happens.
pub type Listener<'a> = &'a (dyn Fn(Event<'_>) + Sync);
