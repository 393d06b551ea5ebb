//! Export and import of the tensors of a network under OpenPCDet's names.

use crate::checkpoint::{HostTensor, HostValues, NamedTensors};
use crate::{ModelError, layers};
use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Gradients, Tensor, TensorData};
use std::collections::BTreeMap;

/// OpenPCDet's name of the tensor at a path of field names, `PointPillars.encoder.backbone_2d.deblocks.0.weight`.
pub fn reference_name(path: &str) -> String {
    crate::tensor_name(&path.split('.').collect::<Vec<_>>())
}

/// The path of field names while visiting a network.
#[derive(Default)]
struct Path(Vec<String>);

impl Path {
    fn name(&self) -> String {
        reference_name(&self.0.join("."))
    }
}

/// A counter as PyTorch stores it.
pub fn counter(value: i64, shape: Vec<usize>) -> HostTensor {
    HostTensor { shape, values: HostValues::I64(vec![value]) }
}

fn is_counter(name: &str) -> bool {
    name.ends_with("num_batches_tracked")
}

/// Every tensor of the network, row-major, by name.
///
/// # Errors
/// Tensors that are not f32.
pub fn to_named<M: Module>(network: &M) -> Result<NamedTensors, ModelError> {
    #[derive(Default)]
    struct Collect {
        path: Path,
        tensors: NamedTensors,
        error: Option<ModelError>,
    }
    impl ModuleVisitor for Collect {
        fn enter_module(&mut self, name: &str, _: &str) {
            self.path.0.push(name.into());
        }
        fn exit_module(&mut self, _: &str, _: &str) {
            self.path.0.pop();
        }
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let name = self.path.name();
            let tensor = param.val();
            let shape = tensor.dims().to_vec();
            match layers::host(tensor) {
                Ok(values) if is_counter(&name) => {
                    self.tensors.insert(name, counter(values[0] as i64, vec![]));
                }
                Ok(values) => {
                    self.tensors.insert(name, HostTensor { shape, values: HostValues::F32(values) });
                }
                Err(error) => self.error = Some(error),
            }
        }
    }
    let mut collect = Collect::default();
    network.visit(&mut collect);
    collect.error.map_or(Ok(collect.tensors), Err)
}

/// Names and shapes of the learned parameters, without running statistics.
pub fn trainable<M: Module>(network: &M) -> BTreeMap<String, Vec<usize>> {
    #[derive(Default)]
    struct Shapes(Path, BTreeMap<String, Vec<usize>>);
    impl ModuleVisitor for Shapes {
        fn enter_module(&mut self, name: &str, _: &str) {
            self.0.0.push(name.into());
        }
        fn exit_module(&mut self, _: &str, _: &str) {
            self.0.0.pop();
        }
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let name = self.0.name();
            if !name.contains(".running_") && !is_counter(&name) {
                self.1.insert(name, param.val().dims().to_vec());
            }
        }
    }
    let mut shapes = Shapes::default();
    network.visit(&mut shapes);
    shapes.1
}

/// The same network with the values of `tensors`. Only counters may be missing (files that hold floats only).
///
/// # Errors
/// A tensor that is missing, has another shape or type, or does not belong to this network.
pub fn load_named<M: Module>(network: M, tensors: &NamedTensors) -> Result<M, ModelError> {
    struct Load<'a> {
        path: Path,
        tensors: &'a NamedTensors,
        used: usize,
        wrong: Vec<String>,
    }
    impl ModuleMapper for Load<'_> {
        fn enter_module(&mut self, name: &str, _: &str) {
            self.path.0.push(name.into());
        }
        fn exit_module(&mut self, _: &str, _: &str) {
            self.path.0.pop();
        }
        fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
            let name = self.path.name();
            let shape = param.val().dims();
            let Some(tensor) = self.tensors.get(&name) else {
                if !is_counter(&name) {
                    self.wrong.push(format!("{name} is missing"));
                }
                return param;
            };
            self.used += 1;
            let values = match &tensor.values {
                HostValues::F32(values) if tensor.shape == shape => values.clone(),
                HostValues::I64(values) if is_counter(&name) && values.len() == 1 => vec![values[0] as f32],
                _ => {
                    self.wrong.push(format!("{name} has shape {:?}, this network needs {shape:?}", tensor.shape));
                    return param;
                }
            };
            param.map(|old| {
                let (device, learned) = (old.device(), old.is_require_grad());
                Tensor::from_data(TensorData::new(values, shape), &device).set_require_grad(learned)
            })
        }
    }
    let mut load = Load { path: Path::default(), tensors, used: 0, wrong: Vec::new() };
    let network = network.map(&mut load);
    let foreign = tensors.len() - load.used - usize::from(tensors.contains_key("global_step"));
    if load.wrong.is_empty() && foreign == 0 {
        return Ok(network);
    }
    let mut message = String::from("these weights belong to another network: ");
    message += &load.wrong.iter().take(3).cloned().collect::<Vec<_>>().join("; ");
    if load.wrong.len() > 3 {
        message += &format!("; and {} more", load.wrong.len() - 3);
    }
    if foreign > 0 {
        message += &format!("; {foreign} tensors of the file do not belong to it");
    }
    Err(ModelError::Weights(message))
}

/// The gradient of every learned parameter by name; zero without a gradient.
///
/// # Errors
/// Tensors that are not f32.
pub fn gradients<M: Module>(network: &M, gradients: &Gradients) -> Result<NamedTensors, ModelError> {
    struct Collect<'a> {
        path: Path,
        gradients: &'a Gradients,
        tensors: NamedTensors,
        error: Option<ModelError>,
    }
    impl ModuleVisitor for Collect<'_> {
        fn enter_module(&mut self, name: &str, _: &str) {
            self.path.0.push(name.into());
        }
        fn exit_module(&mut self, _: &str, _: &str) {
            self.path.0.pop();
        }
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let (name, tensor) = (self.path.name(), param.val());
            if !tensor.is_require_grad() {
                return;
            }
            let shape = tensor.dims().to_vec();
            let values = match tensor.grad(self.gradients) {
                Some(gradient) => layers::host(gradient),
                None => Ok(vec![0.0; shape.iter().product()]),
            };
            match values {
                Ok(values) => {
                    self.tensors.insert(name, HostTensor { shape, values: HostValues::F32(values) });
                }
                Err(error) => self.error = Some(error),
            }
        }
    }
    let mut collect = Collect { path: Path::default(), gradients, tensors: NamedTensors::new(), error: None };
    network.visit(&mut collect);
    collect.error.map_or(Ok(collect.tensors), Err)
}
