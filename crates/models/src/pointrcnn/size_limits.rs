//! Largest sizes of PointRCNN.

use super::config::{PointRcnnConfig, SuppressionConfig};
use crate::limits::{MOST_FILTERS, MOST_LAYERS, MOST_NETWORK_BOXES, MOST_NETWORK_POINTS, MOST_SAMPLES, at_most};

impl PointRcnnConfig {
    /// Whether no size is beyond the limits; the message names the key.
    pub(super) fn check_limits(&self) -> Result<(), String> {
        let (head, points) = (&self.roi_head, &self.point_head);
        let scales = || self.levels.iter().flat_map(|level| &level.scales);
        let filters = |lists: &mut dyn Iterator<Item = &[usize]>| lists.flatten().copied().collect::<Vec<usize>>();
        let of_levels = filters(&mut scales().map(|scale| &scale.filters[..]));
        let of_propagation = filters(&mut self.propagation.iter().map(|f| &f[..]));
        let of_roi_levels = filters(&mut head.levels.iter().map(|level| &level.filters[..]));
        at_most(
            MOST_FILTERS,
            &[
                ("network.levels.scales.filters", &of_levels),
                ("network.propagation", &of_propagation),
                ("network.point_head.class_filters", &points.class_filters),
                ("network.point_head.box_filters", &points.box_filters),
                ("network.roi_head.xyz_filters", &head.xyz_filters),
                ("network.roi_head.levels.filters", &of_roi_levels),
                ("network.roi_head.global_filters", &head.global_filters),
                ("network.roi_head.class_filters", &head.class_filters),
                ("network.roi_head.box_filters", &head.box_filters),
            ],
        )?;
        let of_scales: Vec<usize> = scales().map(|scale| scale.samples).collect();
        let of_rois: Vec<usize> = head.levels.iter().map(|level| level.samples).collect();
        let samples = [
            ("network.levels.scales.samples", &of_scales[..]),
            ("network.roi_head.points", &[head.points]),
            ("network.roi_head.levels.samples", &of_rois),
        ];
        at_most(MOST_SAMPLES, &samples)?;
        let lists = [
            ("the number of network.levels", &[self.levels.len()][..]),
            ("the number of network.levels.scales", &[scales().count()]),
            ("the number of network.levels.scales.filters", &[of_levels.len()]),
            ("the number of network.roi_head.levels", &[head.levels.len()]),
        ];
        at_most(MOST_LAYERS, &lists)?;
        at_most(MOST_NETWORK_POINTS, &[("network.sampling.points", &[self.sampling.points])])?;
        let suppression = |s: &SuppressionConfig| [s.pre, s.post];
        let (train, test) = (suppression(&self.proposals.train), suppression(&self.proposals.test));
        let boxes = [
            ("network.proposals.train", &train[..]),
            ("network.proposals.test", &test),
            ("network.detection.suppression", &suppression(&self.detection.suppression)),
            ("network.roi_sampling.regions", &[self.roi_sampling.regions]),
        ];
        at_most(MOST_NETWORK_BOXES, &boxes)
    }
}
