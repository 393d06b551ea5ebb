//! Networks on pillars as two ONNX graphs: the pillar feature net, and backbone, neck and head. The scatter of the
//! pillars to the canvas between them, and the decoding of the outputs, are left to the caller.

mod graph;
mod proto;

use crate::bev::{EncoderConfig, PillarInput};
use crate::checkpoint::{HostTensor, HostValues, NamedTensors};
use crate::config::DetectorConfig;
use crate::layers::{Mode, Resampling, host};
use crate::{Detector, ModelError, Network, NetworkConfig, NetworkSample, Sample};
use burn::module::Module as _;
use burn::tensor::Tensor;
use graph::{Dim, Graph, Motion};

/// Epsilon of the batch norms of pillar net and backbone, and of the heads of CenterPoint.
const EPSILON: f64 = 1e-3;
const HEAD_EPSILON: f64 = 1e-5;

/// Branches of a head of CenterPoint.
const BRANCHES: [&str; 5] = ["center", "center_z", "dim", "rot", "hm"];

/// The two graphs of a detector, as bytes of `.onnx` files.
#[derive(Clone, Debug, PartialEq)]
pub struct OnnxGraphs {
    /// Pillar feature net: `features` `[P, points, F]` to `pillar_features` `[P, C]`.
    pub pillar_net: Vec<u8>,
    /// Backbone, neck and head: `spatial_features` `[B, C, ny, nx]` to the outputs of the head.
    pub backbone_head: Vec<u8>,
}

/// The graphs of a detector with its weights.
///
/// # Errors
/// A network that does not read pillars.
pub fn to_onnx(detector: &Detector) -> Result<OnnxGraphs, ModelError> {
    let (config, tensors) = (detector.config(), detector.to_named()?);
    let pillar_net = |net| pillar_net(config, net, &tensors);
    match &config.network {
        NetworkConfig::PointPillars(net) => {
            let (mut graph, neck) = backbone(config, net.encoder(), &tensors)?;
            let anchors = net.anchors.iter().map(|a| a.rotations_rad.len()).sum::<usize>();
            for (layer, name, width) in [
                ("conv_cls", "cls", config.classes.len()),
                ("conv_box", "boxes", 7),
                ("conv_dir_cls", "dir", net.head.dir_bins),
            ] {
                let y = graph.conv(&neck, &format!("dense_head.{layer}"), Motion::Conv(1, 1, 0))?;
                let y = graph.channels_last(&y, &format!("{name}.channels_last"));
                let shape = graph.numbers(&format!("{name}.shape"), &[0, -1, width as i64]);
                let y = graph.add("Reshape", &[&y, &shape], &format!("{name}.rows"), vec![]);
                let [ny, nx] = net.encoder().map(config);
                let dims = vec![Dim::Free("batch"), Dim::Fixed(ny * nx * anchors), Dim::Fixed(width)];
                graph.output(&y, name, dims);
            }
            let backbone_head = graph.encode("PointPillars: backbone, neck and head of lidarshift");
            Ok(OnnxGraphs { pillar_net: pillar_net(net.encoder())?, backbone_head })
        }
        NetworkConfig::CenterPoint(net) => {
            let (mut graph, neck) = backbone(config, net.encoder(), &tensors)?;
            let same = Motion::Conv(3, 1, 1);
            let shared = "dense_head.shared_conv";
            let shared =
                graph.conv_norm_relu(&neck, &format!("{shared}.0"), &format!("{shared}.1"), HEAD_EPSILON, same)?;
            let [ny, nx] = net.encoder().map(config);
            let layers = &net.head.layers;
            for (h, classes) in net.heads(config).iter().enumerate() {
                let depths = [layers.center, layers.center_z, layers.dim, layers.rot, layers.hm];
                let channels = [2, 1, 3, 2, classes.len()];
                for ((branch, depth), channels) in BRANCHES.into_iter().zip(depths).zip(channels) {
                    let prefix = format!("dense_head.heads_list.{h}.{branch}");
                    let mut x = shared.clone();
                    for k in 0..depth - 1 {
                        let (conv, norm) = (format!("{prefix}.{k}.0"), format!("{prefix}.{k}.1"));
                        x = graph.conv_norm_relu(&x, &conv, &norm, HEAD_EPSILON, same)?;
                    }
                    let y = graph.conv(&x, &format!("{prefix}.{}", depth - 1), same)?;
                    let dims = vec![Dim::Free("batch"), Dim::Fixed(channels), Dim::Fixed(ny), Dim::Fixed(nx)];
                    graph.output(&y, &format!("{branch}_{h}"), dims);
                }
            }
            let backbone_head = graph.encode("CenterPoint: backbone, neck and heads of lidarshift");
            Ok(OnnxGraphs { pillar_net: pillar_net(net.encoder())?, backbone_head })
        }
        NetworkConfig::PointRcnn(_) => Err(refused(&config.name)),
    }
}

fn refused(name: &str) -> ModelError {
    ModelError::Weights(format!(
        "{name} is a PointRCNN, which is not exported: farthest points, neighbours and regions of interest are no \
         operators of ONNX; export a PointPillars or CenterPoint"
    ))
}

fn pillar_net(config: &DetectorConfig, net: EncoderConfig<'_>, tensors: &NamedTensors) -> Result<Vec<u8>, ModelError> {
    let mut graph = Graph::new("pillar_net", tensors);
    let (points, last) = (net.pillars.max_points, net.vfe_filters.len() - 1);
    let dims = vec![Dim::Free("pillars"), Dim::Fixed(points), Dim::Fixed(config.channels + 6)];
    let mut x = graph.input("features", dims);
    for i in 0..=last {
        let layer = format!("vfe.pfn_layers.{i}");
        let y = graph.linear_norm_relu(&x, &format!("{layer}.linear"), &format!("{layer}.norm"), EPSILON)?;
        x = graph.maximum(&y, &format!("{layer}.maximum"), i < last);
        if i < last {
            let shape = graph.add("Shape", &[&y], &format!("{layer}.shape"), vec![]);
            let repeated = graph.add("Expand", &[&x, &shape], &format!("{layer}.repeated"), vec![]);
            x = graph.concat(&[&y, &repeated], &format!("{layer}.joined"), 2);
        }
    }
    graph.output(&x, "pillar_features", vec![Dim::Free("pillars"), Dim::Fixed(net.vfe_filters[last])]);
    Ok(graph.encode("Pillar feature net of lidarshift"))
}

/// Backbone and neck; the name of the neck's output.
fn backbone<'a>(
    config: &DetectorConfig,
    net: EncoderConfig<'_>,
    tensors: &'a NamedTensors,
) -> Result<(Graph<'a>, String), ModelError> {
    let mut graph = Graph::new("backbone_head", tensors);
    let [nx, ny, _] = net.pillars.grid_size(config);
    let channels = net.vfe_filters.last().copied().unwrap_or(0);
    let dims = vec![Dim::Free("batch"), Dim::Fixed(channels), Dim::Fixed(ny), Dim::Fixed(nx)];
    let mut x = graph.input("spatial_features", dims);
    let mut ups = Vec::new();
    for (i, layers) in net.backbone.layers.iter().enumerate() {
        for j in 0..=*layers {
            let stride = if j == 0 { net.backbone.strides[i] } else { 1 };
            let name = |k: usize| format!("backbone_2d.blocks.{i}.{}", 3 * j + k);
            x = graph.conv_norm_relu(&x, &name(1), &name(2), EPSILON, Motion::Conv(3, stride, 1))?;
        }
        let motion = match Resampling::of(net.backbone.upsample_strides[i]).unwrap_or(Resampling::Up(1)) {
            Resampling::Up(stride) => Motion::Transposed(stride),
            Resampling::Down(stride) => Motion::Conv(stride, stride, 0),
        };
        let name = |k: usize| format!("backbone_2d.deblocks.{i}.{k}");
        ups.push(graph.conv_norm_relu(&x, &name(0), &name(1), EPSILON, motion)?);
    }
    let parts: Vec<&str> = ups.iter().map(String::as_str).collect();
    let neck = graph.concat(&parts, "spatial_features_2d", 1);
    Ok((graph, neck))
}

/// Inputs and outputs of both graphs for one sample, as this program computes them, by their names in the graphs; and
/// `coords`, the cells y and x of each pillar, `[P, 2]`.
///
/// # Errors
/// A network that does not read pillars, and a sample of another network.
pub fn onnx_check(detector: &Detector, sample: &Sample) -> Result<NamedTensors, ModelError> {
    let mut out = NamedTensors::new();
    let (input, bev) = match (detector.network.valid(), &sample.network) {
        (Network::PointPillars(network), NetworkSample::PointPillars(sample)) => {
            let stages = network.forward(&[sample], Mode::Eval);
            insert(&mut out, "cls", stages.predictions.cls)?;
            insert(&mut out, "boxes", stages.predictions.boxes)?;
            insert(&mut out, "dir", stages.predictions.dir)?;
            (&sample.input, stages.bev)
        }
        (Network::CenterPoint(network), NetworkSample::CenterPoint(sample)) => {
            let stages = network.forward(&[sample], Mode::Eval, &mut |_| ());
            for (h, head) in stages.heads.into_iter().enumerate() {
                let values = [head.center, head.center_z, head.dim, head.rot, head.hm];
                for (branch, value) in BRANCHES.into_iter().zip(values) {
                    insert(&mut out, &format!("{branch}_{h}"), value)?;
                }
            }
            (&sample.input, stages.bev)
        }
        _ => return Err(refused(&detector.config().name)),
    };
    insert(&mut out, "spatial_features", bev.canvas.image())?;
    insert(&mut out, "pillar_features", bev.canvas.features)?;
    let max_points = match &detector.config().network {
        NetworkConfig::PointPillars(net) => net.pillars.max_points,
        NetworkConfig::CenterPoint(net) => net.pillars.max_points,
        NetworkConfig::PointRcnn(_) => return Err(refused(&detector.config().name)),
    };
    out.insert("features".into(), padded(input, max_points));
    let coords = input.pillars.coords_zyx.iter().flat_map(|[_, y, x]| [i64::from(*y), i64::from(*x)]).collect();
    out.insert(
        "coords".into(),
        HostTensor { shape: vec![input.pillars.coords_zyx.len(), 2], values: HostValues::I64(coords) },
    );
    Ok(out)
}

fn insert<const D: usize>(out: &mut NamedTensors, name: &str, tensor: Tensor<D>) -> Result<(), ModelError> {
    let shape = tensor.dims().to_vec();
    out.insert(name.into(), HostTensor { shape, values: HostValues::F32(host(tensor)?) });
    Ok(())
}

/// The decorated points of each pillar, filled up with zeros, `[P, points, F]`.
fn padded(input: &PillarInput, max_points: usize) -> HostTensor {
    let width = input.pillars.channels + 6;
    let pillars = input.pillars.num_points.len();
    let mut values = vec![0.0; pillars * max_points * width];
    let mut rest = &input.features[..];
    for (pillar, count) in values.chunks_exact_mut(max_points * width).zip(&input.pillars.num_points) {
        let (own, others) = rest.split_at(*count as usize * width);
        pillar[..own.len()].copy_from_slice(own);
        rest = others;
    }
    HostTensor { shape: vec![pillars, max_points, width], values: HostValues::F32(values) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::find_detector;
    use burn::tensor::Device;
    use prost::Message as _;
    use proto::ModelProto;

    #[test]
    fn graphs_have_every_name_before_it_is_read() {
        for (name, outputs) in [("pointpillars_small", vec!["cls", "boxes", "dir"]), ("centerpoint", vec![])] {
            let config = find_detector(name).unwrap();
            let graphs = to_onnx(&Detector::new(&config, 1, &Device::flex())).unwrap();
            for bytes in [&graphs.pillar_net, &graphs.backbone_head] {
                let graph = ModelProto::decode(&bytes[..]).unwrap().graph.unwrap();
                let names = graph.input.iter().map(|i| i.name.clone());
                let mut known: Vec<String> =
                    names.chain(graph.initializer.iter().map(|i| i.name.clone())).flatten().collect();
                for node in &graph.node {
                    assert!(node.input.iter().all(|i| known.contains(i)), "{node:?}");
                    assert!(!known.contains(&node.output[0]), "{node:?}");
                    known.extend(node.output.clone());
                }
                let found: Vec<String> = graph.output.iter().filter_map(|o| o.name.clone()).collect();
                assert!(found.iter().all(|name| known.contains(name)));
                if graph.name.as_deref() == Some("backbone_head") && !outputs.is_empty() {
                    assert_eq!(found, outputs);
                }
            }
        }
        let config = find_detector("pointrcnn").unwrap();
        let error = to_onnx(&Detector::new(&config, 1, &Device::flex())).unwrap_err().to_string();
        assert!(error.contains("PointRCNN") && error.contains("no operators of ONNX"), "{error}");
    }
}
