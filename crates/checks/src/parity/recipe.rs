//! Weights computed from tensor names, so that reference values of full-size networks need no checkpoint.
//!
//! FNV-1a of `seed/name` and splitmix64 give a uniform number for each element; layer kinds scale it. All arithmetic is
//! in wrapping u64 and f64, with one final rounding to f32.

use models::checkpoint::{HostTensor, HostValues, NamedTensors};

fn fnv1a(text: &str) -> u64 {
    text.bytes().fold(0xcbf2_9ce4_8422_2325, |h, b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01b3))
}

fn splitmix64(x: u64) -> u64 {
    let z = x.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// The branch of a head of CenterPoint whose output layer has this tensor.
fn branch_of_output(name: &str) -> Option<&str> {
    match name.split('.').collect::<Vec<_>>()[..] {
        ["dense_head", "heads_list", _, branch, _, _] => Some(branch),
        _ => None,
    }
}

fn gain(name: &str) -> f64 {
    match branch_of_output(name) {
        Some("hm" | "rot") => return 0.4,
        Some("center" | "center_z") => return 0.2,
        Some("dim") => return 0.1,
        _ => {}
    }
    const GAINS: [(&str, f64); 8] = [
        ("vfe.", 1.0 / 16.0),
        ("dense_head.conv_cls.", 0.25),
        ("dense_head.conv_box.", 0.1),
        ("dense_head.conv_dir_cls.", 0.4),
        ("point_head.cls_layers.6.", 0.6),
        ("point_head.box_layers.6.", 0.06),
        ("roi_head.cls_layers.7.", 0.6),
        ("roi_head.reg_layers.7.", 0.1),
    ];
    GAINS.iter().find(|(prefix, _)| name.starts_with(prefix)).map_or(1.0, |(_, gain)| *gain)
}

fn base(name: &str) -> f64 {
    match name {
        _ if branch_of_output(name) == Some("hm") => -2.19,
        _ if name.starts_with("dense_head.conv_cls.") => -3.0,
        _ if name.starts_with("point_head.cls_layers.6.") => -2.0,
        _ => 0.0,
    }
}

/// The same tensors with every float changed at random by at most `digits` units in the last place.
pub fn nudged(mut tensors: NamedTensors, trial: u64, digits: u64) -> NamedTensors {
    for (name, tensor) in &mut tensors {
        let key = fnv1a(&format!("{trial}/{name}"));
        if let HostValues::F32(values) = &mut tensor.values {
            for (i, value) in values.iter_mut().enumerate() {
                let step = (splitmix64(key ^ i as u64) % (2 * digits + 1)) as i32 - digits as i32;
                *value = f32::from_bits(value.to_bits().wrapping_add_signed(step));
            }
        }
    }
    tensors
}

/// The values for a tensor with this name and shape. `is_norm`: it belongs to a batch normalisation.
pub fn values(seed: u64, name: &str, shape: &[usize], is_norm: bool) -> Vec<f32> {
    let key = fnv1a(&format!("{seed}/{name}"));
    let count: usize = shape.iter().product();
    let fan = match name.starts_with("backbone_2d.deblocks.") {
        true => shape[0],
        false => shape.iter().skip(1).product(),
    };
    let bound = gain(name) * (6.0 / fan as f64).sqrt();
    let value = |i: u64| {
        let u = (splitmix64(key ^ i) >> 40) as f64 * 2f64.powi(-24);
        let s = 2.0 * u - 1.0;
        match name.rsplit('.').next() {
            Some("running_mean") => 0.2 * s,
            Some("running_var") => 0.5 + u,
            Some("weight") if is_norm => 0.75 + 0.5 * u,
            Some("bias") if is_norm => 0.2 * s,
            Some("bias") => base(name) + 0.1 * s,
            _ => bound * s,
        }
    };
    (0..count as u64).map(|i| value(i) as f32).collect()
}

/// The weights of a network with these tensors; `statistics` replace its running statistics.
pub fn weights(seed: u64, shapes: &NamedTensors, statistics: &NamedTensors) -> NamedTensors {
    let fill = |(name, tensor): (&String, &HostTensor)| {
        if let Some(given) = statistics.get(name) {
            return (name.clone(), given.clone());
        }
        let values = match &tensor.values {
            HostValues::I64(v) => HostValues::I64(vec![0; v.len()]),
            _ => {
                let (layer, _) = name.rsplit_once('.').unwrap_or((name, ""));
                let is_norm = shapes.contains_key(&format!("{layer}.running_mean"));
                HostValues::F32(self::values(seed, name, &tensor.shape, is_norm))
            }
        };
        (name.clone(), HostTensor { shape: tensor.shape.clone(), values })
    };
    shapes.iter().map(fill).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn worked_example() {
        assert_eq!(fnv1a("10/vfe.pfn_layers.0.linear.weight"), 0xe084_9d72_00f7_a7a4);
        let linear = values(10, "vfe.pfn_layers.0.linear.weight", &[64, 10], false);
        assert_eq!(linear[..2], [-0.013_020_405f32, -0.034_348_287f32]);
        let deblock = values(10, "backbone_2d.deblocks.1.0.weight", &[128, 128, 2, 2], false);
        assert_eq!(deblock[..2], [-0.076_477_31f32, 0.210_321_96f32]);
        let bias = values(10, "dense_head.conv_cls.bias", &[18], false);
        assert_eq!(bias[0], -3.021_146f32);
        let norm = values(10, "vfe.pfn_layers.0.norm.weight", &[64], true);
        assert_eq!(norm[0], 0.906_403_2f32);
    }
}
