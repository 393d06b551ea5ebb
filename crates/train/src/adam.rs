//! Adam with decoupled weight decay and clipping by the global norm: OpenPCDet's `adam_onecycle`.

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use kernels::{AdamStep, Parameter};
use models::checkpoint::{HostTensor, HostValues, NamedTensors};
use models::gpu_kernels;
use models::kernel_ops::FlexValues;
use std::collections::BTreeMap;

const BETA2: f64 = 0.99;
const EPSILON: f64 = 1e-8;

/// Maps a parameter's path in the module (`backbone.blocks.0.conv.weight`) to its name in files and messages.
pub type NameOf = fn(&str) -> String;

/// Adam whose `beta1` may change between steps; the bias correction uses the current one. Weight decay is decoupled: it
/// is applied to all parameters before the step, including batch norms and biases.
///
/// The moments are stored by parameter name, so that training continues with a module that was saved and loaded.
pub struct Adam {
    weight_decay: f64,
    name_of: NameOf,
    steps: u64,
    moments: BTreeMap<String, Moments>,
}

/// Running means of a parameter's gradient and squared gradient, flat, on the parameter's device.
struct Moments {
    shape: Vec<usize>,
    exp_avg: Tensor<1>,
    exp_avg_sq: Tensor<1>,
}

impl Adam {
    /// The state before the first step.
    pub fn new(weight_decay: f64, name_of: NameOf) -> Self {
        Adam { weight_decay, name_of, steps: 0, moments: BTreeMap::new() }
    }

    /// Updates every trainable parameter of `module`.
    ///
    /// Gradients are first multiplied by `gradient_scale` (see [`GradientNorm::clip_scale`]). Parameters without a
    /// gradient get weight decay only.
    pub fn step<M: Module>(
        &mut self,
        module: M,
        gradients: GradientsParams,
        gradient_scale: f64,
        (lr, beta1): (f64, f64),
    ) -> M {
        self.steps += 1;
        let step = AdamStep {
            learning_rate: lr,
            beta1,
            beta2: BETA2,
            epsilon: EPSILON,
            weight_decay: self.weight_decay,
            step: self.steps,
            gradient_scale,
        };
        let mut stepper = Stepper { adam: self, gradients, step, path: Vec::new() };
        module.map(&mut stepper)
    }

    /// The moments as `exp_avg.<parameter>` and `exp_avg_sq.<parameter>`, in the parameters' shapes.
    pub fn to_named(&self) -> NamedTensors {
        let mut named = NamedTensors::new();
        for (name, m) in &self.moments {
            for (kind, values) in [("exp_avg", &m.exp_avg), ("exp_avg_sq", &m.exp_avg_sq)] {
                let values = values.clone().into_data().try_into_vec::<f32>().expect("moments are f32");
                named.insert(
                    format!("{kind}.{name}"),
                    HostTensor { shape: m.shape.clone(), values: HostValues::F32(values) },
                );
            }
        }
        named
    }

    /// Restores moments written by [`Adam::to_named`] after `steps` steps. The error message names the moment that does
    /// not fit.
    pub fn load_named(&mut self, named: &NamedTensors, steps: u64, device: &Device) -> Result<(), String> {
        let device = device.clone().inner();
        let flat = |kind: &str, name: &str| -> Result<(Vec<usize>, Tensor<1>), String> {
            let key = format!("{kind}.{name}");
            let tensor = named.get(&key).ok_or_else(|| format!("{key} is missing"))?;
            let HostValues::F32(values) = &tensor.values else { return Err(format!("{key} is not f32")) };
            let data = TensorData::new(values.clone(), [values.len()]);
            Ok((tensor.shape.clone(), Tensor::from_data(data, &device)))
        };
        self.moments.clear();
        for key in named.keys() {
            let Some(name) = key.strip_prefix("exp_avg.") else { continue };
            let (shape, exp_avg) = flat("exp_avg", name)?;
            let (shape_sq, exp_avg_sq) = flat("exp_avg_sq", name)?;
            if shape != shape_sq {
                return Err(format!("the moments of {name} have shapes {shape:?} and {shape_sq:?}"));
            }
            self.moments.insert(name.into(), Moments { shape, exp_avg, exp_avg_sq });
        }
        self.steps = steps;
        Ok(())
    }

    fn update(
        &mut self,
        name: String,
        value: Tensor<1>,
        shape: Vec<usize>,
        gradient: Option<Tensor<1>>,
        step: &AdamStep,
    ) -> Tensor<1> {
        let Some(gradient) = gradient else {
            return value.mul_scalar(1.0 - step.learning_rate * step.weight_decay);
        };
        let (exp_avg, exp_avg_sq) = match self.moments.remove(&name) {
            Some(m) => (m.exp_avg, m.exp_avg_sq),
            None => (gradient.zeros_like(), gradient.zeros_like()),
        };
        let tensors = [value, gradient, exp_avg, exp_avg_sq];
        let [moved, exp_avg, exp_avg_sq] = match update_by_kernel(tensors, step) {
            Ok(updated) => updated,
            Err(tensors) => gpu_kernels::adam(tensors, step).unwrap_or_else(|tensors| update_on_device(tensors, step)),
        };
        self.moments.insert(name, Moments { shape, exp_avg, exp_avg_sq });
        moved
    }
}

/// Computes new value and moments from value, gradient and moments with the CPU kernel. Without a kernel the inputs are
/// returned as the error.
#[expect(clippy::result_large_err, reason = "the tensors are returned if there is no kernel")]
fn update_by_kernel(tensors: [Tensor<1>; 4], step: &AdamStep) -> Result<[Tensor<1>; 3], [Tensor<1>; 4]> {
    let Some(values) = tensors.iter().map(FlexValues::of).collect::<Option<Vec<_>>>() else { return Err(tensors) };
    let [value, gradient, exp_avg, exp_avg_sq] = <[FlexValues; 4]>::try_from(values).expect("one for each tensor");
    let device = tensors[0].device();
    drop(tensors); // so that the moments are updated in place
    let [mut value, mut exp_avg, mut exp_avg_sq] = [value, exp_avg, exp_avg_sq].map(FlexValues::into_vec);
    step.apply(vec![Parameter {
        value: &mut value,
        gradient: Some(gradient.as_slice()),
        exp_avg: &mut exp_avg,
        exp_avg_sq: &mut exp_avg_sq,
    }]);
    let length = value.len();
    Ok([value, exp_avg, exp_avg_sq].map(|values| Tensor::from_data(TensorData::new(values, [length]), &device)))
}

/// The same with burn's operations.
fn update_on_device([value, gradient, exp_avg, exp_avg_sq]: [Tensor<1>; 4], step: &AdamStep) -> [Tensor<1>; 3] {
    let AdamStep { learning_rate, beta1, beta2, epsilon, weight_decay, step, gradient_scale } = *step;
    let gradient = if gradient_scale == 1.0 { gradient } else { gradient.mul_scalar(gradient_scale) };
    let exp_avg = exp_avg.mul_scalar(beta1).add(gradient.clone().mul_scalar(1.0 - beta1));
    let exp_avg_sq = exp_avg_sq.mul_scalar(beta2).add(gradient.clone().mul(gradient).mul_scalar(1.0 - beta2));
    let steps = step as f64;
    let correction1 = 1.0 - beta1.powf(steps);
    let correction2 = 1.0 - beta2.powf(steps);
    let denominator = exp_avg_sq.clone().sqrt().div_scalar(correction2.sqrt()).add_scalar(epsilon);
    let decayed = value.mul_scalar(1.0 - learning_rate * weight_decay);
    let moved = decayed.sub(exp_avg.clone().div(denominator).mul_scalar(learning_rate / correction1));
    [moved, exp_avg, exp_avg_sq]
}

struct Stepper<'a> {
    adam: &'a mut Adam,
    gradients: GradientsParams,
    step: AdamStep,
    path: Vec<String>,
}

impl ModuleMapper for Stepper<'_> {
    fn enter_module(&mut self, name: &str, _container_type: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        if !param.is_require_grad() {
            return param; // a running statistic, or frozen
        }
        let name = (self.adam.name_of)(&self.path.join("."));
        let gradient = self.gradients.remove::<D>(param.id).map(|gradient| gradient.flatten::<1>(0, D - 1));
        param.map(|tensor| {
            let shape = tensor.dims();
            let value = tensor.inner().flatten::<1>(0, D - 1);
            let moved = self.adam.update(name, value, shape.to_vec(), gradient, &self.step);
            Tensor::from_inner(moved.reshape(shape)).require_grad()
        })
    }
}

/// The global L2 norm of the gradients of all parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct GradientNorm {
    /// The norm before clipping.
    pub total: f64,
    /// The first parameter, in the module's order, whose gradient has a NaN or an infinity (or, on a GPU, overflows f32
    /// when squared).
    pub not_finite: Option<String>,
}

impl GradientNorm {
    /// The norm of the gradients of `module`, in one transfer from the device.
    pub fn of<M: Module>(module: &M, gradients: &GradientsParams, name_of: NameOf) -> Self {
        GradientNorm::beside(None, module, gradients, name_of).0
    }

    /// The same and other values, in one transfer for both.
    ///
    /// # Shapes
    /// `values`: `[V]`, f32, without autodiff graph; V values on the host, none without `values`.
    pub fn beside<M: Module>(
        values: Option<Tensor<1>>,
        module: &M,
        gradients: &GradientsParams,
        name_of: NameOf,
    ) -> (Self, Vec<f32>) {
        let host = |tensor: Tensor<1>| tensor.into_data().try_into_vec::<f32>().expect("losses and gradients are f32");
        let mut visitor = FlatGradients { gradients, path: Vec::new(), names: Vec::new(), flat: Vec::new() };
        module.visit(&mut visitor);
        let FlatGradients { names, flat, .. } = visitor;
        if flat.is_empty() {
            return (GradientNorm { total: 0.0, not_finite: None }, values.map_or_else(Vec::new, host));
        }
        let name = |i: usize| name_of(&names[i]);
        if let Some(gradients) = flat.iter().map(FlexValues::of).collect::<Option<Vec<_>>>() {
            let norm = kernels::GradientNorm::of(&gradients.iter().map(FlexValues::as_slice).collect::<Vec<_>>());
            let norm = GradientNorm { total: norm.total, not_finite: norm.not_finite.map(name) };
            return (norm, values.map_or_else(Vec::new, host));
        }
        let parameters = flat.len();
        let sums = gpu_kernels::sums_of_squares(&flat).unwrap_or_else(|| {
            Tensor::cat(flat.into_iter().map(|gradient| gradient.clone().mul(gradient).sum()).collect(), 0)
        });
        let mut sums = host(Tensor::cat(std::iter::once(sums).chain(values).collect(), 0));
        let values = sums.split_off(parameters);
        let not_finite = sums.iter().position(|s| !s.is_finite()).map(name);
        (GradientNorm { total: sums.iter().map(|&s| s as f64).sum::<f64>().sqrt(), not_finite }, values)
    }

    /// Factor of the gradients that limits their norm to `max_norm`, as in `torch.nn.utils.clip_grad_norm_`.
    pub fn clip_scale(&self, max_norm: f64) -> f64 {
        (max_norm / (self.total + 1e-6)).min(1.0)
    }
}

struct FlatGradients<'a> {
    gradients: &'a GradientsParams,
    path: Vec<String>,
    names: Vec<String>,
    flat: Vec<Tensor<1>>,
}

impl ModuleVisitor for FlatGradients<'_> {
    fn enter_module(&mut self, name: &str, _container_type: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        if let Some(gradient) = self.gradients.get::<D>(param.id) {
            self.names.push(self.path.join("."));
            self.flat.push(gradient.flatten(0, D - 1));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::OneCycle;
    use burn::nn::{BatchNorm, BatchNormConfig, Linear, LinearConfig};
    use models::config::OptimizationConfig;
    use safetensors::SafeTensors;

    #[derive(Module, Debug)]
    struct Toy {
        linear0: Linear,
        norm1: BatchNorm,
        linear3: Linear,
        norm4: BatchNorm,
        linear6: Linear,
    }

    impl Toy {
        fn new(device: &Device) -> Self {
            let norm = || BatchNormConfig::new(16).with_epsilon(1e-3).with_momentum(0.01).init(device);
            Toy {
                linear0: LinearConfig::new(6, 16).with_bias(false).init(device),
                norm1: norm(),
                linear3: LinearConfig::new(16, 16).with_bias(false).init(device),
                norm4: norm(),
                linear6: LinearConfig::new(16, 4).init(device),
            }
        }

        fn forward(&self, x: Tensor<2>) -> Tensor<2> {
            let x = burn::tensor::activation::relu(self.norm1.forward(self.linear0.forward(x)));
            let x = burn::tensor::activation::relu(self.norm4.forward(self.linear3.forward(x)));
            self.linear6.forward(x)
        }
    }

    /// Names as in a torch `Sequential`: `linear0.weight` is `0.weight`, `norm1.gamma` is `1.weight`.
    fn sequential_name(path: &str) -> String {
        let (layer, leaf) = path.split_once('.').unwrap();
        let leaf = match leaf {
            "gamma" => "weight",
            "beta" => "bias",
            other => other,
        };
        format!("{}.{leaf}", layer.trim_start_matches(|c: char| c.is_alphabetic()))
    }

    struct Golden(Vec<u8>);

    impl Golden {
        fn open() -> Self {
            let path =
                concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/operators/adam_onecycle_toy.safetensors");
            Golden(std::fs::read(path).unwrap())
        }

        fn f32(&self, name: &str) -> (Vec<usize>, Vec<f32>) {
            let all = SafeTensors::deserialize(&self.0).unwrap();
            let t = all.tensor(name).unwrap();
            (t.shape().to_vec(), t.data().chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect())
        }

        fn log(&self) -> Vec<[f64; 4]> {
            let all = SafeTensors::deserialize(&self.0).unwrap();
            let values: Vec<f64> = all
                .tensor("f64.log_lr_beta1_loss_gradnorm")
                .unwrap()
                .data()
                .chunks_exact(8)
                .map(|b| f64::from_le_bytes(b.try_into().unwrap()))
                .collect();
            values.chunks_exact(4).map(|row| row.try_into().unwrap()).collect()
        }
    }

    /// Loads the golden values into a module, or compares them. Linear weights of burn are the transpose of torch's.
    struct Exchange<'a> {
        golden: &'a Golden,
        prefix: &'a str,
        compare: bool,
        path: Vec<String>,
    }

    impl ModuleMapper for Exchange<'_> {
        fn enter_module(&mut self, name: &str, _: &str) {
            self.path.push(name.into());
        }
        fn exit_module(&mut self, _: &str, _: &str) {
            self.path.pop();
        }
        fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
            if !param.is_require_grad() {
                return param;
            }
            let name = sequential_name(&self.path.join("."));
            let (shape, values) = self.golden.f32(&format!("{}.{name}", self.prefix));
            param.map(|tensor| {
                let data = TensorData::new(values, shape);
                let mut want = Tensor::<D>::from_data(data, &tensor.device().inner());
                if D == 2 {
                    want = want.swap_dims(0, 1);
                }
                if !self.compare {
                    return Tensor::from_inner(want).require_grad();
                }
                let norm = |t: Tensor<D>| t.powi_scalar(2).sum().into_scalar::<f32>().sqrt();
                let error = norm(tensor.clone().inner() - want.clone()) / norm(want);
                assert!(error < 1e-5, "{} {name}: relative error {error}", self.prefix);
                tensor
            })
        }
    }

    fn run(steps: usize, from: Option<(Toy, NamedTensors, usize)>, golden: &Golden) -> (Toy, Adam) {
        let device = Device::flex().autodiff();
        let schedule = OneCycle::new(&OptimizationConfig { lr_max: 0.01, ..Default::default() }, 20);
        let mut adam = Adam::new(0.01, sequential_name);
        let (mut toy, first) = match from {
            Some((toy, moments, first)) => {
                adam.load_named(&moments, first as u64, &device).unwrap();
                (toy, first)
            }
            None => {
                let fill = |prefix, toy: Toy| toy.map(&mut Exchange { golden, prefix, compare: false, path: vec![] });
                (fill("initial", Toy::new(&device)), 0)
            }
        };
        let ((x_shape, x), (y_shape, y)) = (golden.f32("x"), golden.f32("y"));
        let x = Tensor::<3>::from_data(TensorData::new(x, x_shape), &device);
        let y = Tensor::<3>::from_data(TensorData::new(y, y_shape), &device);
        let log = golden.log();
        for (i, logged) in log.iter().enumerate().take(steps).skip(first) {
            let (x, y) = (x.clone().narrow(0, i, 1).squeeze_dim::<2>(0), y.clone().narrow(0, i, 1).squeeze_dim::<2>(0));
            let scale = if i % 2 == 0 { 0.3 } else { 3.0 };
            let loss = (toy.forward(x) - y).powi_scalar(2).sum_dim(1).mean().mul_scalar(scale);
            let value = loss.clone().into_scalar::<f32>() as f64;
            let gradients = GradientsParams::from_grads(loss.backward(), &toy);
            let norm = GradientNorm::of(&toy, &gradients, sequential_name);
            let (lr, beta1) = schedule.at(i as u64);
            for (what, got, want) in [("lr", lr, 0), ("beta1", beta1, 1), ("loss", value, 2), ("norm", norm.total, 3)]
                .map(|(what, got, column)| (what, got, logged[column]))
            {
                assert!((got / want - 1.0).abs() < 1e-5, "{what} of step {i}: {got} instead of {want}");
            }
            assert_eq!(norm.not_finite, None);
            toy = adam.step(toy, gradients, norm.clip_scale(10.0), (lr, beta1));
            let prefix = ["after_step1", "after_step2"].get(i).copied().or((i == 19).then_some("final"));
            if let Some(prefix) = prefix {
                toy = toy.map(&mut Exchange { golden, prefix, compare: true, path: vec![] });
            }
        }
        (toy, adam)
    }

    #[test]
    fn equals_the_reference_for_twenty_steps() {
        run(20, None, &Golden::open());
    }

    #[test]
    fn saved_and_loaded_moments_continue_bit_equal() {
        let golden = Golden::open();
        let (whole, _) = run(20, None, &golden);
        let (half, adam) = run(7, None, &golden);
        let (resumed, _) = run(20, Some((half, adam.to_named(), 7)), &golden);
        let bits = |toy: Toy| toy.linear3.weight.val().into_data().try_into_vec::<f32>().unwrap();
        assert_eq!(bits(whole), bits(resumed));
    }

    #[test]
    fn names_the_parameter_whose_gradient_is_not_a_number() {
        let device = Device::flex().autodiff();
        let toy = Toy::new(&device);
        let x = Tensor::<2>::ones([4, 6], &device);
        let loss = toy.forward(x).sum() + toy.linear6.bias.as_ref().unwrap().val().mul_scalar(f32::NAN).sum();
        let gradients = GradientsParams::from_grads(loss.backward(), &toy);
        let norm = GradientNorm::of(&toy, &gradients, sequential_name);
        assert_eq!(norm.not_finite.as_deref(), Some("6.bias"));
    }

    #[test]
    fn losses_are_read_beside_the_norm() {
        #[expect(deprecated, reason = "it has no kernels")]
        let ndarray = Device::ndarray();
        for device in [Device::flex().autodiff(), ndarray.autodiff()] {
            let toy = Toy::new(&device);
            let loss = toy.forward(Tensor::<2>::ones([4, 6], &device)).sum();
            let value: f32 = loss.clone().into_scalar();
            let values = Tensor::cat(vec![loss.clone().inner(), loss.clone().inner() * 2.0], 0);
            let gradients = GradientsParams::from_grads(loss.backward(), &toy);
            let (norm, values) = GradientNorm::beside(Some(values), &toy, &gradients, sequential_name);
            assert_eq!((norm, values), (GradientNorm::of(&toy, &gradients, sequential_name), vec![value, 2.0 * value]));
        }
    }
}
