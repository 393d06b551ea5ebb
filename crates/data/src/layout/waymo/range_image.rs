//! Range images: a row for each inclination of a beam, a column for each azimuth.

use super::super::pose_text::pose_from_rows;
use super::super::table::Table;
use crate::DataError;
use geometry::Pose;
use nalgebra::{Point3, Translation3, UnitQuaternion};
use std::f64::consts::PI;

/// Values of a pixel of a range image: range (m), intensity, elongation, whether it lies in a zone without labels.
const CHANNELS: usize = 4;

/// Values of a pixel of a pose image: roll, pitch, yaw (rad), x, y, z (m).
const POSE_CHANNELS: usize = 6;

/// Most rows or columns of an image.
const MOST_SIDE: i64 = 65_535;

/// Inclinations of the beams of a LiDAR, rad.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Inclinations {
    /// Of each beam, ascending: the last one is that of row 0.
    Each(Vec<f64>),
    /// Between a least and a largest one, in the middle of equal parts.
    Uniform(f64, f64),
}

impl Inclinations {
    /// The inclinations of the rows of an image, from row 0.
    fn rows(&self, height: usize) -> Result<Vec<f64>, String> {
        match self {
            Inclinations::Each(values) if values.len() == height => Ok(values.iter().rev().copied().collect()),
            Inclinations::Each(values) => {
                Err(format!("its range image has {height} rows, but its calibration {} inclinations", values.len()))
            }
            Inclinations::Uniform(least, most) => {
                let step = (most - least) / height as f64;
                Ok((0..height).rev().map(|row| least + (row as f64 + 0.5) * step).collect())
            }
        }
    }
}

/// Where a LiDAR is on the vehicle, and where its beams point.
#[derive(Clone, Debug)]
pub(super) struct Laser {
    /// Pose of the sensor in the frame of the vehicle.
    pub vehicle_from_sensor: Pose,
    /// Azimuth of the sensor's x axis in the frame of the vehicle, rad. Columns of images begin behind the vehicle.
    azimuth_rad: f64,
    inclinations: Inclinations,
}

impl Laser {
    /// From the 4x4 matrix of the extrinsic calibration, row by row.
    ///
    /// # Errors
    /// What is no pose, and inclinations that are not finite or not ascending.
    pub(super) fn new(extrinsic: &[f64], inclinations: Inclinations) -> Result<Laser, String> {
        let given = match &inclinations {
            Inclinations::Each(values) => &values[..],
            Inclinations::Uniform(least, most) => &[*least, *most],
        };
        let right = |v: &f64| v.abs() <= PI / 2.0;
        if !(given.iter().all(right) && given.is_sorted()) {
            return Err("its inclinations are not ascending, or not within 90 degrees (rad are expected)".into());
        }
        let vehicle_from_sensor = pose_from_matrix(extrinsic)?;
        Ok(Laser { vehicle_from_sensor, azimuth_rad: extrinsic[4].atan2(extrinsic[0]), inclinations })
    }
}

/// The pose of a 4x4 matrix, row by row.
pub(super) fn pose_from_matrix(rows: &[f64]) -> Result<Pose, String> {
    if rows.len() != 16 {
        return Err(format!("a pose has 16 values (4x4, row by row), not {}", rows.len()));
    }
    pose_from_rows(&rows[..12])
}

/// An image with several values a pixel.
struct Image {
    height: usize,
    width: usize,
    values: Vec<f64>,
}

impl Image {
    /// The image of the first row of a table.
    fn of(table: &Table, [values, shape]: [&str; 2], channels: usize) -> Result<Image, DataError> {
        let wrong = |message: String| table.wrong(0, &message);
        let absent = |name: &str| wrong(format!("column {name} is empty"));
        let sides = table.integer_lists(shape)?.swap_remove(0).ok_or_else(|| absent(shape))?;
        let [height, width] = match sides[..] {
            [h, w, c] if c == channels as i64 && [h, w].iter().all(|s| (1..=MOST_SIDE).contains(s)) => [h, w],
            _ => {
                let most = MOST_SIDE;
                return Err(wrong(format!(
                    "column {shape} is {sides:?}, not rows, columns and {channels}; both from 1 to {most}"
                )));
            }
        };
        let [height, width] = [height as usize, width as usize];
        let found = table.real_lists(values)?.swap_remove(0).ok_or_else(|| absent(values))?;
        if found.len() != height * width * channels {
            let count = found.len();
            return Err(wrong(format!("column {values} has {count} values, not {height} x {width} x {channels}")));
        }
        Ok(Image { height, width, values: found })
    }
}

/// Points of a scan in the order of the sensors, rows and columns.
#[derive(Default)]
pub(super) struct Scan {
    /// x, y, z, intensity of each point.
    pub values: Vec<f32>,
    /// Row of each point. The rows of a sensor follow those of the sensor before.
    pub rings: Vec<u16>,
    /// Number of rows of all sensors.
    rows: usize,
}

/// Names of the columns of an image: values and shape.
pub(super) type Columns = [&'static str; 2];

impl Scan {
    /// Adds the points of a range image, the first row of `image`. `poses` has the pose of the vehicle in the world for
    /// each pixel, and the pose of the world in the vehicle at the stamp; without it the vehicle stands still.
    ///
    /// `lidar_from_vehicle` brings points to the LiDAR frame.
    pub(super) fn add(
        &mut self,
        laser: &Laser,
        (image, columns): (&Table, Columns),
        poses: Option<(&Table, Columns, Pose)>,
        lidar_from_vehicle: Translation3<f64>,
    ) -> Result<(), DataError> {
        let ranges = Image::of(image, columns, CHANNELS)?;
        let (height, width) = (ranges.height, ranges.width);
        let poses = poses.map(|(table, columns, vehicle_from_world)| {
            let poses = Image::of(table, columns, POSE_CHANNELS)?;
            if (poses.height, poses.width) != (height, width) {
                let (h, w) = (poses.height, poses.width);
                let message = format!("the poses are of {h} x {w} pixels, but the range image has {height} x {width}");
                return Err(table.wrong(0, &message));
            }
            Ok((poses, vehicle_from_world))
        });
        let poses = poses.transpose()?;
        let inclinations = laser.inclinations.rows(height).map_err(|message| image.wrong(0, &message))?;
        let azimuth = |column: usize| {
            let share = (width as f64 - column as f64 - 0.5) / width as f64;
            (2.0 * share - 1.0) * PI - laser.azimuth_rad
        };
        let azimuths: Vec<[f64; 2]> = (0..width).map(azimuth).map(|a| [a.cos(), a.sin()]).collect();
        let first = self.rows;
        self.rows += height;
        if self.rows > usize::from(u16::MAX) {
            return Err(image.wrong(0, "the images of the frame have more than 65535 rows"));
        }
        for (row, inclination) in inclinations.iter().enumerate() {
            let (up, along) = inclination.sin_cos();
            for (column, [cos, sin]) in azimuths.iter().enumerate() {
                let pixel = row * width + column;
                let range = ranges.values[CHANNELS * pixel];
                if !(range > 0.0) {
                    continue;
                }
                let seen = Point3::new(along * cos, along * sin, up) * range;
                let mut point = laser.vehicle_from_sensor * seen;
                if let Some((poses, vehicle_from_world)) = &poses {
                    let pose = &poses.values[POSE_CHANNELS * pixel..][..POSE_CHANNELS];
                    point = vehicle_from_world * (pose_of_pixel(pose) * point);
                }
                let point = lidar_from_vehicle * point;
                let intensity = ranges.values[CHANNELS * pixel + 1];
                self.values.extend([point.x, point.y, point.z, intensity].map(|v| v as f32));
                self.rings.push((first + row) as u16);
            }
        }
        Ok(())
    }
}

/// The pose of the vehicle in the world: a yaw about z, then a pitch about the new y, then a roll about the new x.
fn pose_of_pixel(values: &[f64]) -> Pose {
    let rotation = UnitQuaternion::from_euler_angles(values[0], values[1], values[2]);
    Pose::from_parts(Translation3::new(values[3], values[4], values[5]), rotation)
}
