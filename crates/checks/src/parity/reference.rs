//! Files of reference numbers, and the account of what was compared.

use anyhow::{Context, Result};
use models::checkpoint::{HostTensor, HostValues, NamedTensors, read_safetensors};
use serde::Serialize;
use std::collections::BTreeSet;
use std::path::Path;

/// One comparison.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// File of the folder, without its ending.
    pub file: String,
    /// Tensor of that file.
    pub tensor: String,
    /// Relative L2 distance; for whole numbers the share that differs; `null` where nothing could be compared.
    pub error: Option<f64>,
    /// Largest error that passes.
    pub tolerance: f64,
    /// Whether it does.
    pub pass: bool,
}

/// One file of reference numbers, and what of it was compared so far.
pub struct ReferenceFile {
    name: String,
    tensors: NamedTensors,
    seen: BTreeSet<String>,
    rows: Vec<Row>,
}

impl ReferenceFile {
    /// Reads `NAME.safetensors` of the folder.
    pub fn read(folder: &Path, name: &str) -> Result<Self> {
        let tensors = read_safetensors(&folder.join(format!("{name}.safetensors")))?;
        Ok(ReferenceFile { name: name.into(), tensors, seen: BTreeSet::new(), rows: Vec::new() })
    }

    /// Whether there is such a tensor.
    pub fn has(&self, tensor: &str) -> bool {
        self.tensors.contains_key(tensor)
    }

    /// Names of all tensors.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.tensors.keys().map(String::as_str)
    }

    /// A tensor that is an input, or that says how others are stored.
    pub fn input(&mut self, tensor: &str) -> Result<&HostTensor> {
        self.seen.insert(tensor.into());
        self.tensors.get(tensor).with_context(|| format!("{}.safetensors has no tensor {tensor}", self.name))
    }

    /// The values of a float input.
    pub fn floats(&mut self, tensor: &str) -> Result<Vec<f32>> {
        Ok(numbers(self.input(tensor)?).into_iter().map(|v| v as f32).collect())
    }

    /// The values of an integer input.
    pub fn ints(&mut self, tensor: &str) -> Result<Vec<i64>> {
        Ok(numbers(self.input(tensor)?).into_iter().map(|v| v as i64).collect())
    }

    /// The values of a stage that the file holds, and how many of the whole tensor's lie from one to the next.
    pub fn sampled(&mut self, stage: &str) -> Result<(Vec<f32>, usize)> {
        if self.has(stage) {
            return Ok((self.floats(stage)?, 1));
        }
        let step = self.ints(&format!("{stage}.step"))?[0].max(1) as usize;
        Ok((self.floats(&format!("{stage}.sample"))?, step))
    }

    /// Compares one tensor, value by value.
    pub fn compare(&mut self, tensor: &str, ours: &[f64], tolerance: f64) -> Result<()> {
        let reference = self.input(tensor)?.clone();
        let error = distance(&reference, ours);
        self.push(tensor, error, tolerance);
        Ok(())
    }

    /// Compares a stage, in every form that the file holds it: whole, sampled, first rows, shape, sums, norm.
    pub fn compare_stage(&mut self, stage: &str, ours: &[f64], shape: &[usize], tolerance: f64) -> Result<()> {
        let member = |form: &str| format!("{stage}.{form}");
        if self.has(stage) {
            self.compare(stage, ours, tolerance)?;
        }
        if self.has(&member("sample")) {
            let step = self.ints(&member("step"))?[0].max(1) as usize;
            let sampled: Vec<f64> = ours.iter().step_by(step).copied().collect();
            match self.has(&member("l2")) {
                true => self.compare_gradient_sample(stage, &sampled, ours.len(), tolerance)?,
                false => self.compare(&member("sample"), &sampled, tolerance)?,
            }
        }
        if self.has(&member("first8")) {
            let count = numbers(self.input(&member("first8"))?).len();
            self.compare(&member("first8"), &ours[..count.min(ours.len())], tolerance)?;
        }
        if self.has(&member("shape")) {
            let shape: Vec<f64> = shape.iter().map(|&d| d as f64).collect();
            self.compare(&member("shape"), &shape, 0.0)?;
        }
        let magnitude: f64 = ours.iter().map(|v| v.abs()).sum();
        for (form, value) in [("sum", ours.iter().sum::<f64>()), ("abs_sum", magnitude)] {
            if self.has(&member(form)) {
                // A sum of signed numbers is measured against the sum of their magnitudes.
                let reference = numbers(self.input(&member(form))?)[0];
                let error = (value - reference).abs() / magnitude.max(reference.abs()).max(f64::MIN_POSITIVE);
                self.push(&member(form), Some(error), tolerance);
            }
        }
        if self.has(&member("l2")) {
            self.compare(&member("l2"), &[ours.iter().map(|v| v * v).sum::<f64>().sqrt()], tolerance)?;
        }
        Ok(())
    }

    /// A few values of a gradient may all be small: their largest error is measured against the gradient's rms.
    fn compare_gradient_sample(&mut self, parameter: &str, ours: &[f64], count: usize, tolerance: f64) -> Result<()> {
        let rms = numbers(self.input(&format!("{parameter}.l2"))?)[0] / (count as f64).sqrt();
        let name = format!("{parameter}.sample");
        let truth = numbers(self.input(&name)?);
        let largest = truth.iter().zip(ours).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        let error = largest / if rms > 0.0 { rms } else { 1.0 };
        self.push(&name, (truth.len() == ours.len() && error.is_finite()).then_some(error), tolerance);
        Ok(())
    }

    fn push(&mut self, tensor: &str, error: Option<f64>, tolerance: f64) {
        let pass = error.is_some_and(|e| e <= tolerance);
        self.seen.insert(tensor.into());
        self.rows.push(Row { file: self.name.clone(), tensor: tensor.into(), error, tolerance, pass });
    }

    /// All rows; a tensor that nothing was compared with is a failure.
    pub fn finish(mut self) -> Vec<Row> {
        let missed: Vec<String> = self.tensors.keys().filter(|k| !self.seen.contains(*k)).cloned().collect();
        for tensor in missed {
            self.push(&tensor, None, 0.0);
        }
        self.rows
    }
}

/// The values of a tensor in double precision.
pub fn numbers(tensor: &HostTensor) -> Vec<f64> {
    match &tensor.values {
        HostValues::F32(v) => v.iter().map(|&x| f64::from(x)).collect(),
        HostValues::F64(v) => v.clone(),
        HostValues::I64(v) => v.iter().map(|&x| x as f64).collect(),
    }
}

/// Relative L2 of floats, share of different whole numbers; nothing when the lengths differ.
fn distance(reference: &HostTensor, ours: &[f64]) -> Option<f64> {
    let truth = numbers(reference);
    if truth.len() != ours.len() {
        return None;
    }
    if let HostValues::I64(_) = reference.values {
        let different = truth.iter().zip(ours).filter(|(a, b)| a != b).count();
        return Some(different as f64 / truth.len().max(1) as f64);
    }
    let square = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>();
    let difference = square(&mut truth.iter().zip(ours).map(|(a, b)| a - b));
    let size = square(&mut truth.iter().copied());
    // Where the reference is zero throughout, the distance itself is the error.
    let error = (difference / if size > 0.0 { size } else { 1.0 }).sqrt();
    error.is_finite().then_some(error)
}
