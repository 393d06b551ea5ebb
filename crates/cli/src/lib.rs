//! The program: detectors trained in simulation, measured on the road.
