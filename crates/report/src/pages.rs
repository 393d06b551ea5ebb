//! What is put together of figures and tables: a file for each thing that is reported on.

pub(crate) mod comparison;
pub(crate) mod diagnosis;
pub(crate) mod study;
