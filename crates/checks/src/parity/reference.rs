//! Files with reference values, and the list of comparisons.

use anyhow::{Context, Result};
use models::checkpoint::{HostTensor, HostValues, NamedTensors, read_safetensors};
use schemars::JsonSchema;
use serde::Serialize;
use std::collections::BTreeSet;
use std::path::Path;

/// Comparison of a tensor.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct Row {
    /// File name without extension.
    pub file: String,
    /// Name of the tensor.
    pub tensor: String,
    /// Relative L2 distance, or the share of different values for integers; `null` if it was not compared.
    pub error: Option<f64>,
    /// Largest error that passes.
    pub tolerance: f64,
    /// Whether the error is within the tolerance.
    pub pass: bool,
}

/// How the samples of a gradient are compared. Errors are relative to the rms of the gradient, since all samples may be
/// small.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Samples {
    /// The largest error.
    Largest,
    /// The rms of the errors, an estimate of the relative L2 distance of the whole gradient.
    Rms,
}

/// A file with reference values, and the comparisons so far.
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

    /// Whether the file has this tensor.
    pub fn has(&self, tensor: &str) -> bool {
        self.tensors.contains_key(tensor)
    }

    /// Names of all tensors.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.tensors.keys().map(String::as_str)
    }

    /// A tensor that is an input or metadata, and need not be compared.
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

    /// The stored samples of a stage, and their step in the whole tensor.
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

    /// Compares a stage in every stored form: whole, sampled, first rows, shape, sums, norm.
    pub fn compare_stage(&mut self, stage: &str, ours: &[f64], shape: &[usize], tolerance: f64) -> Result<()> {
        let member = |form: &str| format!("{stage}.{form}");
        if self.has(stage) {
            self.compare(stage, ours, tolerance)?;
        }
        if self.has(&member("sample")) {
            let step = self.ints(&member("step"))?[0].max(1) as usize;
            let sampled: Vec<f64> = ours.iter().step_by(step).copied().collect();
            self.compare(&member("sample"), &sampled, tolerance)?;
        }
        if self.has(&member("first8")) {
            let count = numbers(self.input(&member("first8"))?).len();
            self.compare(&member("first8"), &ours[..count.min(ours.len())], tolerance)?;
        }
        if self.has(&member("shape")) {
            let shape: Vec<f64> = shape.iter().map(|&d| d as f64).collect();
            self.compare(&member("shape"), &shape, 0.0)?;
        }
        self.compare_sums(stage, ours, tolerance)
    }

    fn compare_sums(&mut self, stage: &str, ours: &[f64], tolerance: f64) -> Result<()> {
        let member = |form: &str| format!("{stage}.{form}");
        let magnitude: f64 = ours.iter().map(|v| v.abs()).sum();
        for (form, value) in [("sum", ours.iter().sum::<f64>()), ("abs_sum", magnitude)] {
            if self.has(&member(form)) {
                // The error of a sum is relative to the sum of the absolute values.
                let reference = numbers(self.input(&member(form))?)[0];
                let error = (value - reference).abs() / magnitude.max(reference.abs()).max(f64::MIN_POSITIVE);
                self.push(&member(form), Some(error), tolerance);
            }
        }
        Ok(())
    }

    /// Compares a gradient by its samples, sum and norm.
    pub fn compare_gradient(&mut self, parameter: &str, ours: &[f64], tolerance: f64, samples: Samples) -> Result<()> {
        let norm = numbers(self.input(&format!("{parameter}.l2"))?)[0];
        let rms = norm / (ours.len() as f64).sqrt();
        let errors = self.sample_errors(parameter, ours)?;
        let error = errors.map(|errors| match samples {
            Samples::Largest => errors.iter().copied().fold(0.0, f64::max),
            Samples::Rms => (errors.iter().map(|e| e * e).sum::<f64>() / errors.len().max(1) as f64).sqrt(),
        });
        let error = error.map(|error| error / if rms > 0.0 { rms } else { 1.0 }).filter(|e| e.is_finite());
        self.push(&format!("{parameter}.sample"), error, tolerance);
        self.compare_sums(parameter, ours, tolerance)?;
        self.compare(&format!("{parameter}.l2"), &[ours.iter().map(|v| v * v).sum::<f64>().sqrt()], tolerance)
    }

    /// Compares a gradient that is zero in exact arithmetic: samples, sum and norm of both sides are rounding errors,
    /// relative to `largest`, the largest gradient of the network.
    pub fn compare_zero_gradient(&mut self, parameter: &str, ours: &[f64], largest: f64, tolerance: f64) -> Result<()> {
        let largest = largest.max(f64::MIN_POSITIVE);
        let errors = self.sample_errors(parameter, ours)?;
        let error = errors.map(|errors| errors.into_iter().fold(0.0, f64::max) / largest).filter(|e| e.is_finite());
        self.push(&format!("{parameter}.sample"), error, tolerance);
        let n = ours.len() as f64;
        for (form, value, size) in
            [("sum", ours.iter().sum::<f64>(), n), ("l2", ours.iter().map(|v| v * v).sum::<f64>().sqrt(), n.sqrt())]
        {
            let reference = numbers(self.input(&format!("{parameter}.{form}"))?)[0];
            self.push(&format!("{parameter}.{form}"), Some((value - reference).abs() / (size * largest)), tolerance);
        }
        Ok(())
    }

    /// The distance of each sample of a gradient; `None` if their numbers differ.
    fn sample_errors(&mut self, parameter: &str, ours: &[f64]) -> Result<Option<Vec<f64>>> {
        let step = self.ints(&format!("{parameter}.step"))?[0].max(1) as usize;
        let truth = numbers(self.input(&format!("{parameter}.sample"))?);
        let ours: Vec<f64> = ours.iter().step_by(step).copied().collect();
        let distances = truth.iter().zip(&ours).map(|(a, b)| (a - b).abs());
        Ok((truth.len() == ours.len()).then(|| distances.collect()))
    }

    fn push(&mut self, tensor: &str, error: Option<f64>, tolerance: f64) {
        let pass = error.is_some_and(|e| e <= tolerance);
        self.seen.insert(tensor.into());
        self.rows.push(Row { file: self.name.clone(), tensor: tensor.into(), error, tolerance, pass });
    }

    /// All rows. A tensor that was not compared is a failure.
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

/// Relative L2 distance of floats, or the share of different integers; `None` if the lengths differ.
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
    // If all reference values are zero, the error is the absolute distance.
    let error = (difference / if size > 0.0 { size } else { 1.0 }).sqrt();
    error.is_finite().then_some(error)
}
