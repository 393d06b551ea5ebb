//! One run: optimiser, schedule, checkpoints, resume.
