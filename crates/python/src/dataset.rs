//! Data sets and clouds on disk.

use crate::arrays::{array_of, array_of_boxes, bytes_of};
use crate::errors::{raised, with_place};
use data::{DataError, Moment, PointColumns, PointDetails, TrackedObject};
use geometry::Box3;
use pyo3::prelude::*;
use pyo3::types::PyByteArray;
use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

/// Columns by their name in a data set's TOML.
fn columns_of(py: Python<'_>, name: &str) -> PyResult<PointColumns> {
    match name {
        "xyz" => Ok(PointColumns::Xyz),
        "xyzi" => Ok(PointColumns::Xyzi),
        _ => Err(with_place(py, &format!("columns are {name:?}; give \"xyz\" or \"xyzi\""), None)),
    }
}

/// Points as bytes, and the values of a point.
type Points<'py> = (Bound<'py, PyByteArray>, usize);

/// Reads a `.bin` or `.pcd`.
#[pyfunction]
pub fn read_cloud<'py>(py: Python<'py>, path: PathBuf, columns: &str) -> PyResult<Points<'py>> {
    let columns = columns_of(py, columns)?;
    let cloud = py.detach(|| data::read_cloud(&path, columns)).map_err(|e| raised(py, e))?;
    Ok(array_of(py, &cloud))
}

/// A data set on disk.
#[pyclass(frozen, module = "lidarshift._native")]
pub struct Dataset {
    inner: data::Dataset,
    /// Of all frames, from the first time that one is asked for.
    moments: Mutex<Option<HashMap<String, Moment>>>,
}

/// A frame: points, boxes, classes, tracks, stamp, pose, ring, time.
type Parts<'py> = (
    Points<'py>,
    Bound<'py, PyByteArray>,
    Vec<String>,
    Vec<Option<String>>,
    Option<f64>,
    Option<Bound<'py, PyByteArray>>,
    Option<Bound<'py, PyByteArray>>,
    Option<Bound<'py, PyByteArray>>,
);

/// What is read of a frame.
struct Read {
    frame: data::Frame,
    tracks: Vec<Option<String>>,
    moment: Option<Moment>,
    details: PointDetails,
}

#[pymethods]
impl Dataset {
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let inner = py.detach(|| data::Dataset::open(&path)).map_err(|e| raised(py, e))?;
        Ok(Dataset { inner, moments: Mutex::new(None) })
    }

    #[getter]
    fn name(&self) -> &str {
        &self.inner.config.name
    }

    #[getter]
    fn root(&self) -> PathBuf {
        self.inner.config.root.clone()
    }

    #[getter]
    fn layout(&self) -> &'static str {
        self.inner.config.layout.name()
    }

    #[getter]
    fn rig(&self) -> Option<PathBuf> {
        self.inner.config.rig.clone()
    }

    #[getter]
    fn classes(&self) -> Vec<String> {
        self.inner.config.classes.clone()
    }

    #[getter]
    fn splits(&self) -> Vec<String> {
        self.inner.config.splits.keys().cloned().collect()
    }

    fn ids(&self, py: Python<'_>, split: Option<&str>) -> PyResult<Vec<String>> {
        let ids = py.detach(|| split.map_or_else(|| self.inner.all_ids(), |split| self.inner.ids(split)));
        ids.map_err(|e| raised(py, e))
    }

    fn cloud<'py>(&self, py: Python<'py>, id: &str) -> PyResult<Points<'py>> {
        let cloud = py.detach(|| self.inner.load_cloud(id)).map_err(|e| raised(py, e))?;
        Ok(array_of(py, &cloud))
    }

    fn frame<'py>(&self, py: Python<'py>, id: &str) -> PyResult<Parts<'py>> {
        let Read { frame, tracks, moment, details } = py.detach(|| self.read(id)).map_err(|e| raised(py, e))?;
        let boxes: Vec<Box3> = frame.objects.iter().map(|o| o.bbox).collect();
        let classes = frame.objects.into_iter().map(|o| o.class).collect();
        let (stamp_s, pose) = moment.map_or((None, None), |m| (m.stamp_s, m.world_from_lidar));
        let pose = pose.map(|pose| {
            let matrix = pose.to_homogeneous();
            let values: Vec<f64> = (0..16).map(|i| matrix[(i / 4, i % 4)]).collect();
            bytes_of(py, &values, f64::to_le_bytes)
        });
        // Of a cloud that is cropped to an image, the details have more points.
        let points = frame.cloud.len();
        let ring = details.ring.filter(|r| r.len() == points).map(|r| bytes_of(py, &r, u16::to_le_bytes));
        let time = details.time_s.filter(|t| t.len() == points).map(|t| bytes_of(py, &t, f32::to_le_bytes));
        Ok((array_of(py, &frame.cloud), array_of_boxes(py, &boxes), classes, tracks, stamp_s, pose, ring, time))
    }
}

impl Dataset {
    fn read(&self, id: &str) -> Result<Read, DataError> {
        let set = &self.inner;
        let cloud = set.load_cloud(id)?;
        let lines = if set.has_labels() { set.labels(id)? } else { Vec::new() };
        let frame = data::Frame { id: id.into(), cloud, objects: set.objects(id, &lines)? };
        let moment = self.moment(id)?;
        let solid = lines.iter().filter(|line| !line.is_dont_care() && line.has_box());
        let mut tracks: Vec<Option<String>> = solid.map(|line| line.track.map(|t| t.to_string())).collect();
        // Names of tracks that are no numbers are known to the moment alone.
        let tracked: &[TrackedObject] = moment.as_ref().map_or(&[], |m| &m.objects);
        if tracked.len() == tracks.len() && tracked.iter().zip(&frame.objects).all(|(t, o)| t.class == o.class) {
            tracks = tracked.iter().map(|t| Some(t.track.clone())).collect();
        }
        Ok(Read { frame, tracks, moment, details: set.point_details(id)? })
    }

    fn moment(&self, id: &str) -> Result<Option<Moment>, DataError> {
        let mut moments = self.moments.lock().unwrap_or_else(PoisonError::into_inner);
        if moments.is_none() {
            let mut all = HashMap::new();
            for sequence in self.inner.sequences()? {
                all.extend(self.inner.moments(&sequence.ids)?.into_iter().map(|m| (m.id.clone(), m)));
            }
            *moments = Some(all);
        }
        Ok(moments.as_ref().and_then(|all| all.get(id)).cloned())
    }
}
