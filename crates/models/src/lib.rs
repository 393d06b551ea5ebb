//! PointPillars in burn, faithful to the published network to the last tensor.
