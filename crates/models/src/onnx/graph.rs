//! A graph that is built node by node from the tensors of a checkpoint. Batch norms are folded into the weights.

use super::proto::{
    AttributeProto, DimensionProto, GraphProto, ModelProto, NodeProto, OperatorSetIdProto, TensorProto,
    TensorShapeProto, TensorTypeProto, TypeProto, ValueInfoProto, attribute_type, element,
};
use crate::ModelError;
use crate::checkpoint::{HostValues, NamedTensors};
use prost::Message as _;

/// Version of the operators.
const OPSET: i64 = 17;

/// Version of the format.
const IR_VERSION: i64 = 8;

/// A dimension of an input or output.
pub enum Dim {
    /// Known.
    Fixed(usize),
    /// Not known, with a name.
    Free(&'static str),
}

/// A graph under construction.
pub struct Graph<'a> {
    tensors: &'a NamedTensors,
    proto: GraphProto,
}

/// How a convolution moves over its input.
#[derive(Clone, Copy)]
pub enum Motion {
    /// A convolution with this kernel, stride and padding.
    Conv(usize, usize, usize),
    /// A transposed convolution with kernel = stride.
    Transposed(usize),
}

fn int(name: &str, value: i64) -> AttributeProto {
    let name = Some(name.to_owned());
    AttributeProto { name, i: Some(value), kind: Some(attribute_type::INT), ..AttributeProto::default() }
}

fn ints(name: &str, values: Vec<i64>) -> AttributeProto {
    let name = Some(name.to_owned());
    AttributeProto { name, ints: values, kind: Some(attribute_type::INTS), ..AttributeProto::default() }
}

fn info(name: &str, dims: Vec<Dim>) -> ValueInfoProto {
    let dim = |dim| match dim {
        Dim::Fixed(n) => DimensionProto { dim_value: Some(n as i64), dim_param: None },
        Dim::Free(name) => DimensionProto { dim_value: None, dim_param: Some(name.into()) },
    };
    let shape = Some(TensorShapeProto { dim: dims.into_iter().map(dim).collect() });
    let tensor_type = Some(TensorTypeProto { elem_type: Some(element::FLOAT), shape });
    ValueInfoProto { name: Some(name.into()), r#type: Some(TypeProto { tensor_type }) }
}

impl<'a> Graph<'a> {
    /// An empty graph.
    pub fn new(name: &str, tensors: &'a NamedTensors) -> Self {
        Graph { tensors, proto: GraphProto { name: Some(name.into()), ..GraphProto::default() } }
    }

    /// Adds an input.
    pub fn input(&mut self, name: &str, dims: Vec<Dim>) -> String {
        self.proto.input.push(info(name, dims));
        name.into()
    }

    /// Makes a value an output of this name.
    pub fn output(&mut self, value: &str, name: &str, dims: Vec<Dim>) {
        self.add("Identity", &[value], name, vec![]);
        self.proto.output.push(info(name, dims));
    }

    /// Adds an operation with one output.
    pub fn add(&mut self, kind: &str, inputs: &[&str], output: &str, attribute: Vec<AttributeProto>) -> String {
        self.proto.node.push(NodeProto {
            input: inputs.iter().map(|s| (*s).to_owned()).collect(),
            output: vec![output.into()],
            name: Some(output.into()),
            op_type: Some(kind.into()),
            attribute,
        });
        output.into()
    }

    /// Adds a constant.
    fn constant(&mut self, name: &str, shape: &[usize], values: &[f32]) -> String {
        self.initializer(name, shape, element::FLOAT, values.iter().flat_map(|v| v.to_le_bytes()).collect())
    }

    /// Adds a list of whole numbers.
    pub fn numbers(&mut self, name: &str, values: &[i64]) -> String {
        let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.initializer(name, &[values.len()], element::INT64, bytes)
    }

    fn initializer(&mut self, name: &str, shape: &[usize], data_type: i32, raw_data: Vec<u8>) -> String {
        self.proto.initializer.push(TensorProto {
            dims: shape.iter().map(|d| *d as i64).collect(),
            data_type: Some(data_type),
            name: Some(name.into()),
            raw_data: Some(raw_data),
        });
        name.into()
    }

    /// Values and shape of a tensor of the checkpoint.
    fn tensor(&self, name: &str) -> Result<(Vec<f32>, Vec<usize>), ModelError> {
        match self.tensors.get(name).map(|t| (&t.values, &t.shape)) {
            Some((HostValues::F32(values), shape)) => Ok((values.clone(), shape.clone())),
            Some(_) => Err(ModelError::Weights(format!("{name} is not f32"))),
            None => Err(ModelError::Weights(format!("{name} is missing"))),
        }
    }

    /// Factor and shift of a batch norm in inference.
    fn norm(&self, name: &str, epsilon: f64) -> Result<Vec<(f64, f64)>, ModelError> {
        let part = |part: &str| Ok::<_, ModelError>(self.tensor(&format!("{name}.{part}"))?.0);
        let [gamma, beta, mean, variance] =
            [part("weight")?, part("bias")?, part("running_mean")?, part("running_var")?];
        let channel = |c: usize| {
            let factor = f64::from(gamma[c]) / (f64::from(variance[c]) + epsilon).sqrt();
            (factor, f64::from(beta[c]) - f64::from(mean[c]) * factor)
        };
        Ok((0..gamma.len()).map(channel).collect())
    }

    /// A linear layer without bias, with its batch norm and a ReLU. `x`: `[.., C_in]`.
    pub fn linear_norm_relu(&mut self, x: &str, layer: &str, norm: &str, epsilon: f64) -> Result<String, ModelError> {
        let (weight, shape) = self.tensor(&format!("{layer}.weight"))?;
        let norm = self.norm(norm, epsilon)?;
        let (outputs, inputs) = (shape[0], shape[1]);
        let transposed: Vec<f32> = (0..inputs)
            .flat_map(|i| (0..outputs).map(move |o| (i, o)))
            .map(|(i, o)| (f64::from(weight[o * inputs + i]) * norm[o].0) as f32)
            .collect();
        let shift: Vec<f32> = norm.iter().map(|n| n.1 as f32).collect();
        let weight = self.constant(&format!("{layer}.folded_weight"), &[inputs, outputs], &transposed);
        let shift = self.constant(&format!("{layer}.folded_bias"), &[outputs], &shift);
        let y = self.add("MatMul", &[x, &weight], &format!("{layer}.product"), vec![]);
        let y = self.add("Add", &[&y, &shift], &format!("{layer}.sum"), vec![]);
        Ok(self.add("Relu", &[&y], &format!("{layer}.relu"), vec![]))
    }

    /// A convolution with its batch norm and a ReLU; the convolution may have a bias.
    pub fn conv_norm_relu(
        &mut self,
        x: &str,
        layer: &str,
        norm: &str,
        epsilon: f64,
        motion: Motion,
    ) -> Result<String, ModelError> {
        let (mut weight, shape) = self.tensor(&format!("{layer}.weight"))?;
        let norm = self.norm(norm, epsilon)?;
        let bias = match self.tensors.contains_key(&format!("{layer}.bias")) {
            true => self.tensor(&format!("{layer}.bias"))?.0,
            false => vec![0.0; norm.len()],
        };
        let inner = shape[2] * shape[3];
        for (i, value) in weight.iter_mut().enumerate() {
            let output = match motion {
                Motion::Conv(..) => i / (inner * shape[1]),
                Motion::Transposed(_) => i / inner % shape[1],
            };
            *value = (f64::from(*value) * norm[output].0) as f32;
        }
        let bias: Vec<f32> = norm.iter().zip(&bias).map(|(n, b)| (n.1 + f64::from(*b) * n.0) as f32).collect();
        let y = self.convolve(x, layer, (&weight, &shape), &bias, motion);
        Ok(self.add("Relu", &[&y], &format!("{layer}.relu"), vec![]))
    }

    /// A convolution with a bias alone.
    pub fn conv(&mut self, x: &str, layer: &str, motion: Motion) -> Result<String, ModelError> {
        let (weight, shape) = self.tensor(&format!("{layer}.weight"))?;
        let bias = self.tensor(&format!("{layer}.bias"))?.0;
        Ok(self.convolve(x, layer, (&weight, &shape), &bias, motion))
    }

    fn convolve(
        &mut self,
        x: &str,
        layer: &str,
        (weight, shape): (&[f32], &[usize]),
        bias: &[f32],
        motion: Motion,
    ) -> String {
        let weight = self.constant(&format!("{layer}.folded_weight"), shape, weight);
        let bias = self.constant(&format!("{layer}.folded_bias"), &[bias.len()], bias);
        let (kind, kernel, stride, pad) = match motion {
            Motion::Conv(kernel, stride, pad) => ("Conv", kernel, stride, pad),
            Motion::Transposed(stride) => ("ConvTranspose", stride, stride, 0),
        };
        let attributes = vec![
            ints("kernel_shape", vec![kernel as i64; 2]),
            ints("strides", vec![stride as i64; 2]),
            ints("pads", vec![pad as i64; 4]),
        ];
        self.add(kind, &[x, &weight, &bias], &format!("{layer}.conv"), attributes)
    }

    /// The maximum over axis 1.
    pub fn maximum(&mut self, x: &str, output: &str, keep: bool) -> String {
        self.add("ReduceMax", &[x], output, vec![ints("axes", vec![1]), int("keepdims", i64::from(keep))])
    }

    /// Values one after the other along an axis.
    pub fn concat(&mut self, parts: &[&str], output: &str, axis: i64) -> String {
        self.add("Concat", parts, output, vec![int("axis", axis)])
    }

    /// `[B, C, H, W]` as `[B, H, W, C]`.
    pub fn channels_last(&mut self, x: &str, output: &str) -> String {
        self.add("Transpose", &[x], output, vec![ints("perm", vec![0, 2, 3, 1])])
    }

    /// The bytes of the file.
    pub fn encode(self, doc: &str) -> Vec<u8> {
        let model = ModelProto {
            ir_version: Some(IR_VERSION),
            producer_name: Some("lidarshift".into()),
            producer_version: Some(env!("CARGO_PKG_VERSION").into()),
            doc_string: Some(doc.into()),
            graph: Some(self.proto),
            opset_import: vec![OperatorSetIdProto { domain: Some(String::new()), version: Some(OPSET) }],
        };
        model.encode_to_vec()
    }
}
