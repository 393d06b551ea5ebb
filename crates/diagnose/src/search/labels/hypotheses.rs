//! Hypotheses about shifts of labels and objects.

use super::rows::{AHEAD, HIGHER};
use crate::catalogue::Cause;

/// A cause with the columns that it needs; see [`super::rows::COLUMNS`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Hypothesis {
    pub(super) cause: Cause,
    pub(super) columns: &'static [usize],
}

const fn of(cause: Cause, columns: &'static [usize]) -> Hypothesis {
    Hypothesis { cause, columns }
}

/// All hypotheses.
pub(super) const HYPOTHESES: [Hypothesis; 14] = [
    of(Cause::LabelOffset, &[0]),
    of(Cause::LabelOffset, &[1]),
    of(Cause::LabelOffset, &[2]),
    of(Cause::LabelOffset, &[0, 1]),
    of(Cause::LabelOffset, &[0, 2]),
    of(Cause::LabelOffset, &[1, 2]),
    of(Cause::LabelOffset, &[0, 1, 2]),
    of(Cause::TimeOffset, &[3]),
    of(Cause::TimeOffset, &[4]),
    of(Cause::WrongShape, &[5]),
    of(Cause::WrongShape, &[6]),
    of(Cause::WrongShape, &[5, HIGHER]),
    of(Cause::RollingShutter, &[7]),
    of(Cause::TimeOffset, TARGETS_CLOCK),
];

/// Columns of a late clock of the objects where the ego speed is not known: the share of the ego speed and that of the
/// relative one.
pub(super) const TARGETS_CLOCK: &[usize] = &[AHEAD, 3];
