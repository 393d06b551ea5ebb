use super::*;

/// A wall at x = 10 m as patches of 5 cm, seen from the origin by 4 frames with 2 cm of alternating noise.
fn wall() -> Vec<Patch> {
    let mut all = Vec::new();
    for frame in 0..4 {
        for i in -40..40 {
            for j in -20..20 {
                let off = if (i + j + frame) % 2 == 0 { 0.02 } else { -0.02 };
                all.push(Patch {
                    place: [10.0 + off, 0.05 * i as f32, 0.05 * j as f32],
                    normal: [-1.0, 0.0, 0.0],
                    axes: [[0.0, 0.025, 0.0], [0.0, 0.0, 0.025]],
                    smooth: true,
                    range_m: 10.0,
                    intensity: 0.3,
                    frame: frame as u32,
                });
            }
        }
    }
    all
}

fn shots(to: impl Fn(f32, f32) -> f32) -> Vec<SeenShot> {
    let shot = |y: f32, z: f32| {
        let direction = Vector3::new(10.0, y, z);
        let range_m = to(y, z) * direction.norm() / 10.0;
        SeenShot { origin: [0.0; 3], direction: direction.normalize().into(), range_m }
    };
    (0..60)
        .flat_map(|i| (0..30).map(move |j| (i, j)))
        .map(|(i, j)| shot(0.05 * i as f32 - 1.5, 0.05 * j as f32 - 0.75))
        .collect()
}

#[test]
fn noise_on_a_wall_is_averaged_and_not_the_nearest() {
    let map = SurfelMap::build(&wall(), [shots(|_, _| 10.0)], &FusionConfig::default());
    let mut met = Vec::new();
    let off: Vec<f32> = shots(|_, _| 10.0)
        .iter()
        .map(|s| map.end(s.origin, s.direction, &mut met).expect("the wall").range_m - s.range_m)
        .collect();
    let mean = off.iter().sum::<f32>() / off.len() as f32;
    assert!(mean.abs() < 2e-3, "{mean}");
    assert!(off.iter().all(|v| v.abs() < 0.015));
    assert!(map.end([0.0; 3], [0.0, 1.0, 0.0], &mut met).is_none());
}

#[test]
fn what_other_shots_passed_is_taken_out() {
    let mut patches = wall();
    // Something stood 3 m in front of the wall in one frame and was gone in the others.
    for i in -10..10 {
        for j in -10..10 {
            let mut ghost = patches[0];
            ghost.place = [7.0, 0.05 * i as f32, 0.05 * j as f32];
            patches.push(ghost);
        }
    }
    let there = shots(|y, z| if y.abs() < 0.3 && z.abs() < 0.3 { 7.0 } else { 10.0 });
    let frames = [there, shots(|_, _| 10.0), shots(|_, _| 10.0), shots(|_, _| 10.0)];
    let map = SurfelMap::build(&patches, frames, &FusionConfig::default());
    let end = map.end([0.0; 3], [1.0, 0.0, 0.0], &mut Vec::new()).unwrap();
    assert!((end.range_m - 10.0).abs() < 0.02, "{end:?}");
}

#[test]
fn the_ply_has_a_record_for_each_surfel() {
    let map = SurfelMap::build(&wall(), [], &FusionConfig::default());
    let bytes = encode_ply(&map);
    let at = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    assert_eq!((bytes.len() - at) / 44, map.surfels().len());
    assert_eq!((bytes.len() - at) % 44, 0);
    let x = f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
    assert!((x - 10.0).abs() < 0.03);
}
