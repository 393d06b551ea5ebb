//! Comparison of twenty training steps of a small network: optimiser, schedule, gradient clipping and batch
//! normalisation together.

use super::reference::ReferenceFile;
use anyhow::Result;
use burn::module::{Module, Param, RunningState};
use burn::optim::GradientsParams;
use burn::tensor::activation::relu;
use burn::tensor::{Device, Tensor, TensorData};
use models::checkpoint::{HostTensor, HostValues};
use models::config::OptimizationConfig;
use models::layers::{BatchNorm, Init};
use models::named;
use train::{Adam, GradientNorm, OneCycle};

/// After twenty steps, single and double precision of the reference differ by 7e-7.
const TOLERANCE: f64 = 1e-5;

/// Linear, norm, ReLU, linear, norm, ReLU, linear, numbered as in a `torch.nn.Sequential`.
#[derive(Module, Debug)]
struct Toy {
    l0: Param<Tensor<2>>,
    l1: BatchNorm,
    l3: Param<Tensor<2>>,
    l4: BatchNorm,
    l6: Last,
}

#[derive(Module, Debug)]
struct Last {
    weight: Param<Tensor<2>>,
    bias: Param<Tensor<1>>,
}

/// Converts a parameter name: `l0` to `0.weight`, `l1.bias` to `1.bias`.
fn toy_name(path: &str) -> String {
    let name = path.trim_start_matches('l');
    if name.contains('.') { name.into() } else { format!("{name}.weight") }
}

impl Toy {
    fn new(file: &mut ReferenceFile, device: &Device) -> Result<Self> {
        let init = Init { seed: 0, device };
        let matrix = |file: &mut ReferenceFile, name: &str| -> Result<Param<Tensor<2>>> {
            let tensor = file.input(&format!("initial.{name}"))?.clone();
            Ok(Param::from_tensor(Tensor::from_data(data_of(&tensor)?, device)))
        };
        let vector = |file: &mut ReferenceFile, name: &str| -> Result<Tensor<1>> {
            let tensor = file.input(&format!("initial.{name}"))?.clone();
            Ok(Tensor::from_data(data_of(&tensor)?, device))
        };
        let norm = |file: &mut ReferenceFile, layer: usize| -> Result<BatchNorm> {
            let mut norm = BatchNorm::new(16, 0.01, 1e-3, &init);
            norm.weight = Param::from_tensor(vector(file, &format!("{layer}.weight"))?);
            norm.bias = Param::from_tensor(vector(file, &format!("{layer}.bias"))?);
            norm.running_mean = RunningState::new(vector(file, &format!("{layer}.running_mean"))?);
            norm.running_var = RunningState::new(vector(file, &format!("{layer}.running_var"))?);
            file.input(&format!("initial.{layer}.num_batches_tracked"))?;
            Ok(norm)
        };
        Ok(Toy {
            l0: matrix(file, "0.weight")?,
            l1: norm(file, 1)?,
            l3: matrix(file, "3.weight")?,
            l4: norm(file, 4)?,
            l6: Last { weight: matrix(file, "6.weight")?, bias: Param::from_tensor(vector(file, "6.bias")?) },
        })
    }

    /// # Shapes
    /// `x`: `[N, 6]`; result `[N, 4]`.
    fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        let x = relu(self.l1.forward_train(x.matmul(self.l0.val().transpose()))); // [N, 16]
        let x = relu(self.l4.forward_train(x.matmul(self.l3.val().transpose()))); // [N, 16]
        x.matmul(self.l6.weight.val().transpose()) + self.l6.bias.val().unsqueeze()
    }
}

fn data_of(tensor: &HostTensor) -> Result<TensorData> {
    let HostValues::F32(values) = &tensor.values else { anyhow::bail!("initial weights must be f32") };
    Ok(TensorData::new(values.clone(), tensor.shape.clone()))
}

/// Repeats the training of the reference and compares weights, losses, gradient norms and schedule.
pub fn compare(file: &mut ReferenceFile, device: &Device) -> Result<()> {
    let config = OptimizationConfig { lr_max: 0.01, ..Default::default() };
    let mut toy = Toy::new(file, device)?;
    let (x, y) = (file.floats("x")?, file.floats("y")?);
    let steps = 20;
    let cycle = OneCycle::new(&config, steps as u64);
    let mut adam = Adam::new(config.weight_decay, toy_name);
    let mut log = Vec::new();
    for step in 0..steps {
        let batch = |values: &[f32], width: usize| {
            let rows = values[step * 32 * width..(step + 1) * 32 * width].to_vec();
            Tensor::<2>::from_data(TensorData::new(rows, [32, width]), device)
        };
        let factor = if step % 2 == 0 { 0.3 } else { 3.0 };
        let difference = toy.forward(batch(&x, 6)) - batch(&y, 4);
        let loss = difference.powi_scalar(2).sum() * (factor / 32.0);
        let gradients = GradientsParams::from_grads(loss.backward(), &toy);
        let norm = GradientNorm::of(&toy, &gradients, toy_name);
        let (lr, beta1) = cycle.at(step as u64);
        toy = adam.step(toy, gradients, norm.clip_scale(config.clip_norm), (lr, beta1));
        log.extend([lr, beta1, f64::from(loss.into_scalar::<f32>()), norm.total]);
        let moment = match step + 1 {
            1 => "after_step1",
            2 => "after_step2",
            n if n == steps => "final",
            _ => continue,
        };
        compare_weights(file, &toy, moment)?;
    }
    file.compare("log_lr_beta1_loss_gradnorm", &log, TOLERANCE)?;
    file.compare("f64.log_lr_beta1_loss_gradnorm", &log, TOLERANCE)
}

fn compare_weights(file: &mut ReferenceFile, toy: &Toy, moment: &str) -> Result<()> {
    for (path, tensor) in named::to_named(toy)? {
        let name = format!("{moment}.{}", toy_name(&path));
        if file.has(&name) {
            file.compare(&name, &super::reference::numbers(&tensor), TOLERANCE)?;
        }
    }
    Ok(())
}
