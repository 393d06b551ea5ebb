//! Writes a case: `measured/`, `simulated/`, `sensor.toml`. The truth is returned and not written next to them.

use crate::case::{Case, Kind};
use crate::effect::Effect;
use crate::rig::{draw_rig, rig_toml};
use crate::scan::{Nuisances, Scan, Side, SideErrors, Sums};
use crate::solid::{Form, Material, Solid};
use crate::variant::Intensity;
use crate::world::{World, draw_world};
use data::{Cloud, DataError, Frame, Layout, Object, write_atomic};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::RngExt;
use rayon::prelude::*;
use score::{FrameEvidence, Hidden, Truth, Verdicts, in_catalogue};
use std::collections::BTreeMap;
use std::path::Path;

/// Writes both sides and the rig into `folder`; returns the truth.
pub fn write_case(case: &Case, folder: &Path) -> Result<Truth, DataError> {
    let mut rng = data::stream(case.seed, "blind world", 0, 0);
    let (rig, above_m) = draw_rig(&mut rng, case.size.shots, case.variant.sensors);
    let simulated_world = draw_world(&mut rng, above_m);
    let mut measured_world = simulated_world.clone();
    for wall in &mut measured_world.walls {
        wall.left_m += rng.random_range(-0.02..0.02);
    }
    for shape in &mut measured_world.shapes {
        let grown = 1.0 + rng.random_range(-0.006..0.006);
        scale_parts(&mut shape.parts, [grown; 3]);
    }
    let nuisances = Nuisances {
        noise_m: rng.random_range(0.003..0.012),
        lost: rng.random_range(0.001..0.015),
        false_returns: rng.random_range(0.0..3e-4),
        weakest: rng.random_range(-14.0..-12.0),
        dither: if rng.random_bool(0.5) { [0.1, 0.03] } else { [0.0, 0.0] },
    };
    let mut beams: Vec<Vec<[f64; 2]>> = rig.iter().map(|m| vec![[0.0; 2]; m.rows_rad.len()]).collect();
    let level = beams.clone();
    for effect in &case.effects {
        match effect {
            Effect::BeamRangeOffset { std_m } => {
                beams.iter_mut().flatten().for_each(|b| b[0] = std_m * 3f64.sqrt() * rng.random_range(-1.0..1.0));
            }
            Effect::BeamElevationOffset { std_rad } => {
                beams.iter_mut().flatten().for_each(|b| b[1] = std_rad * 3f64.sqrt() * rng.random_range(-1.0..1.0));
            }
            Effect::MissingObject { things } => add_things(&mut measured_world, *things, &mut rng),
            Effect::WrongShape { length, height } => {
                for shape in &mut measured_world.shapes {
                    let h = shape.size_m[2];
                    scale_parts(&mut shape.parts, [1.0 + length, 1.0, 1.0 + height]);
                    shape.parts.iter_mut().for_each(|p| p.pose.translation.z += height * h / 2.0);
                }
            }
            _ => {}
        }
    }
    let own = SideErrors { pose: [0.003, 8e-5], labels_m: rng.random_range(0.02..0.05) };
    let measured = Side { world: &measured_world, rig: &rig, nuisances, own, effects: &case.effects, beams: &beams };
    let simulated =
        Side { world: &simulated_world, rig: &rig, nuisances, own: SideErrors::default(), effects: &[], beams: &level };
    write_atomic(&folder.join("sensor.toml"), rig_toml(&rig, case.variant.rig_has_pattern).as_bytes())?;
    let frames: Vec<Result<(Sums, FrameEvidence), DataError>> = (0..case.size.frames)
        .into_par_iter()
        .map(|i| {
            let t = i as f64 * case.step_s;
            let column = |side: &str| (case.variant.intensity, data::stream(case.seed, side, 0, i as u64));
            let mut scan = measured.scan(t, &mut data::stream(case.seed, "blind measured", 0, i as u64));
            let shown =
                if case.kind == Kind::Shuffled { (i + 37 * case.size.frames / 97) % case.size.frames } else { i };
            let frame = (scan.sums, std::mem::take(&mut scan.evidence));
            // Frame ids count scans at 20 Hz, including those that are not kept.
            let every = (case.step_s * 20.0).round() as usize;
            write_scan(&folder.join("measured"), shown * every, scan, column("blind measured intensity"))?;
            let scan = simulated.scan(t, &mut data::stream(case.seed, "blind simulated", 0, i as u64));
            write_scan(&folder.join("simulated"), i * every, scan, column("blind simulated intensity"))?;
            Ok(frame)
        })
        .collect();
    let mut total = Sums::default();
    let mut evidence = Vec::new();
    for frame in frames {
        let (s, e) = frame?;
        evidence.push(e);
        total.returns += s.returns;
        total.lever += s.lever;
        total.touched += s.touched;
        total.boxes = [total.boxes[0] + s.boxes[0], total.boxes[1] + s.boxes[1]];
    }
    let verdicts = measured.judge(&evidence);
    Ok(truth(case, &nuisances, &own, beams.iter().flatten().count(), &total, &verdicts))
}

fn write_scan(
    root: &Path,
    id: usize,
    scan: Scan,
    (intensity, mut rng): (Intensity, data::Stream),
) -> Result<(), DataError> {
    let mut values = Vec::new();
    for (point, light) in scan.points.iter().zip(&scan.lights) {
        values.extend(point);
        values.extend(intensity.value(light, &mut rng));
    }
    let object = |bbox| Object { class: "Car".into(), bbox, truncation: None, occlusion: None, image_box: None };
    let frame = Frame {
        id: format!("{id:06}"),
        cloud: Cloud { values, channels: intensity.channels() },
        objects: scan.boxes.into_iter().map(object).collect(),
    };
    Layout::Kitti.write_frame(root, &frame)?;
    let columns = if intensity.channels() == 3 { "xyz" } else { "xyzi" };
    let text = format!("points = \"{columns}\"\nlabel_frame = \"lidar\"\nclasses = [\"Car\"]\n");
    write_atomic(&root.join("dataset.toml"), text.as_bytes())
}

fn scale_parts(parts: &mut [Solid], by: [f64; 3]) {
    for part in parts {
        let p = part.pose.translation.vector.component_mul(&Vector3::from(by));
        part.pose = Isometry3::from_parts(Translation3::from(p), part.pose.rotation);
        if let Form::Cuboid(half) = &mut part.form {
            half.component_mul_assign(&Vector3::from(by));
        }
    }
}

/// Adds containers beside and behind the walls.
fn add_things(world: &mut World, n: usize, rng: &mut data::Stream) {
    for _ in 0..n {
        let s = rng.random_range(0.0..world.track.lap_m());
        let left = world.walls[0].left_m - rng.random_range(1.5..5.0);
        let ([x, y], heading) = world.track.at(s, left);
        let size = Vector3::new(rng.random_range(2.0..6.0), rng.random_range(0.5..2.5), rng.random_range(2.5..5.0));
        let z = world.track.height_m(x, y) + size.z / 2.0;
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading);
        let pose = Isometry3::from_parts(Translation3::new(x, y, z), turn);
        world.things.push(Solid { pose, form: Form::Cuboid(size / 2.0), material: Material::Container });
    }
}

/// The truth with Cramér-Rao bounds from the Fisher information of the frames' returns. For per-row offsets each
/// offset may be known exactly; the standard deviation of their (uniform) distribution is limited by the number of
/// rows.
fn truth(case: &Case, nuisances: &Nuisances, own: &SideErrors, rows: usize, sums: &Sums, verdicts: &Verdicts) -> Truth {
    let bound = |effect: &Effect| -> BTreeMap<String, f64> {
        let own_variance = 2.0 * nuisances.noise_m.powi(2);
        let n = sums.returns.max(1.0);
        let of_rows = (0.2 / rows as f64).sqrt();
        let list: Vec<(&str, f64)> = match effect {
            Effect::RangeNoise { sigma_m, .. } => {
                vec![("std_m", (sigma_m.powi(2) + own_variance) / sigma_m / (2.0 * n).sqrt())]
            }
            Effect::BeamRangeOffset { std_m } => vec![("std_m", std_m * of_rows)],
            Effect::BeamElevationOffset { std_rad } => vec![("std_deg", std_rad.to_degrees() * of_rows)],
            Effect::RandomDropout { share } => vec![("share", (share * (1.0 - share) / n).sqrt())],
            Effect::Outliers { share } => vec![("rate", (share / n).sqrt())],
            Effect::AngularJitter { sigma_rad } => {
                let signal = sigma_rad.powi(2) * sums.lever / n;
                vec![("std_deg", sigma_rad.to_degrees() * (signal + own_variance) / signal / (2.0 * n).sqrt())]
            }
            Effect::TimeOffset { .. } => vec![("offset_s", own.labels_m / sums.boxes[1].max(1.0).sqrt())],
            Effect::LabelOffset { .. } => {
                let se = own.labels_m / sums.boxes[0].max(1.0).sqrt();
                vec![("forward_m", se), ("left_m", se), ("up_m", se)]
            }
            _ => vec![],
        };
        list.into_iter().map(|(k, v)| (k.to_owned(), v)).collect()
    };
    let hidden = case.effects.iter().enumerate().map(|(k, effect)| {
        let hidden = Hidden {
            cause: effect.cause().map_or_else(|| format!("{effect:?}"), str::to_owned),
            in_catalogue: effect.cause().is_some_and(in_catalogue),
            parameters: effect.parameters(),
            bound: bound(effect),
            touched: if case.effects.len() > 2 { verdicts.touched(k) } else { sums.touched },
            ..Hidden::default()
        };
        hidden.with_strength(verdicts.strength(k))
    });
    let kind = match case.kind {
        Kind::Null => "null",
        Kind::Single(_) => "single",
        Kind::Pair(..) => "pair",
        Kind::OffCatalogue(_) => "off_catalogue",
        Kind::Shuffled => "shuffled",
        Kind::Swarm(_) => "swarm",
    };
    Truth { seed: case.seed, kind: kind.into(), setting: String::new(), hidden: hidden.collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::case::draw_case;
    use score::CaseSize;

    #[test]
    fn a_case_is_a_pure_function_of_its_seed_and_leaks_nothing() {
        let size = CaseSize { frames: 2, shots: 3_000 };
        let case = draw_case(5, Kind::Null, size);
        let folders = [(); 2].map(|()| {
            let folder = tempfile();
            write_case(&case, &folder.0).unwrap();
            folder
        });
        let read = |k: usize, name: &str| fs_err::read(folders[k].0.join(name)).unwrap();
        let second = format!("velodyne/{:06}.bin", (case.step_s * 20.0).round() as usize);
        for name in [&format!("measured/{second}"), &format!("simulated/{second}"), "sensor.toml"] {
            assert_eq!(read(0, name), read(1, name));
        }
        let points =
            |bytes: Vec<u8>| bytes.chunks_exact(12).map(<[u8]>::to_vec).collect::<std::collections::BTreeSet<_>>();
        let (a, b) = (points(read(0, &format!("measured/{second}"))), points(read(0, &format!("simulated/{second}"))));
        assert!(a.len() > 1_000 && a.intersection(&b).count() == 0, "{} points", a.len());
    }

    struct Folder(std::path::PathBuf);

    impl Drop for Folder {
        fn drop(&mut self) {
            let _ = fs_err::remove_dir_all(&self.0);
        }
    }

    fn tempfile() -> Folder {
        use std::sync::atomic::{AtomicUsize, Ordering};
        static N: AtomicUsize = AtomicUsize::new(0);
        let name = format!("lidarshift-blind-{}-{}", std::process::id(), N.fetch_add(1, Ordering::Relaxed));
        Folder(std::env::temp_dir().join(name))
    }
}
