//! S2R-DAD's layout: `data/pcl/*.pcd` and `data/label/*.txt`, without calibration.

use super::file_per_frame::{CloudFormat, FilePerFrame};
use crate::Layout;

/// The layout of S2R-DAD.
pub(super) struct S2rDad;

impl FilePerFrame for S2rDad {
    const LAYOUT: Layout = Layout::S2rDad;
    const NAME: &'static str = "s2r_dad";
    const MARKERS: &'static [&'static str] = &["data/pcl/ (S2R-DAD)"];
    const FOLDERS: [&'static str; 2] = ["data/pcl", "data/label"];
    const CLOUDS: CloudFormat = CloudFormat::Pcd;
}
