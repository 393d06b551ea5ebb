//! A simulated twin of recorded scenes: the static world as a map made of all scans, moving objects, the sensor's
//! pattern, and the same moments shot again.

pub mod odometry;
pub mod poses;
