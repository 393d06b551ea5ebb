//! Synthetic LiDAR data sets by seeded ray casting.
