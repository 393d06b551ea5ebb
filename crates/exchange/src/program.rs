//! The programs for which files are written.

/// A simulator of LiDAR sensors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Program {
    /// CARLA, `sensor.lidar.ray_cast`.
    Carla,
    /// NVIDIA Isaac Sim, RTX LiDAR (`OmniLidar` prims).
    Isaac,
    /// Gazebo, `gpu_lidar` in SDF.
    Gazebo,
    /// Robotec GPU LiDAR, the library behind AWSIM: its C API.
    Rgl,
    /// HELIOS++, scanner and platform XML.
    Helios,
}

impl Program {
    /// All programs.
    pub const ALL: [Program; 5] = [Program::Carla, Program::Isaac, Program::Gazebo, Program::Rgl, Program::Helios];

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Program::Carla => "carla",
            Program::Isaac => "isaac",
            Program::Gazebo => "gazebo",
            Program::Rgl => "rgl",
            Program::Helios => "helios",
        }
    }

    /// Its name in texts.
    pub fn title(self) -> &'static str {
        match self {
            Program::Carla => "CARLA",
            Program::Isaac => "Isaac Sim",
            Program::Gazebo => "Gazebo",
            Program::Rgl => "Robotec GPU LiDAR",
            Program::Helios => "HELIOS++",
        }
    }
}
