//! Shapes of classes as patches, for objects that hardly returned a shot.

use crate::map::Patch;

/// Edge of a patch, m.
const EDGE_M: f32 = 0.1;

/// A cuboid in units of the box: low and high corner, -0.5 to 0.5.
type Part = [[f32; 3]; 2];

/// A body with a cabin on it.
const CAR: &[Part] = &[[[-0.5, -0.5, -0.4], [0.5, 0.5, 0.05]], [[-0.38, -0.42, 0.05], [0.22, 0.42, 0.5]]];
/// A cuboid above its wheels.
const TALL: &[Part] = &[[[-0.5, -0.5, -0.42], [0.5, 0.5, 0.5]]];
/// Legs, a trunk and a head.
const PERSON: &[Part] = &[
    [[-0.2, -0.3, -0.5], [0.2, 0.3, 0.0]],
    [[-0.3, -0.45, 0.0], [0.3, 0.45, 0.35]],
    [[-0.2, -0.2, 0.35], [0.2, 0.2, 0.5]],
];
/// A bicycle with a person on it.
const CYCLIST: &[Part] = &[[[-0.5, -0.1, -0.5], [0.5, 0.1, 0.0]], [[-0.25, -0.4, -0.1], [0.15, 0.4, 0.5]]];

/// Patches on the faces of the shape of a class, in the frame of a box of this size (m).
pub(super) fn patches(class: &str, size: [f64; 3]) -> Vec<Patch> {
    let name = class.to_ascii_lowercase();
    let has = |words: &[&str]| words.iter().any(|w| name.contains(w));
    let parts = if has(&["cycl", "bike", "moto"]) {
        CYCLIST
    } else if has(&["pedestrian", "person", "sitting"]) {
        PERSON
    } else if has(&["van", "truck", "bus", "tram", "trailer"]) {
        TALL
    } else {
        CAR
    };
    parts
        .iter()
        .flat_map(|part| faces(part.map(|corner| std::array::from_fn(|k| corner[k] * size[k] as f32))))
        .collect()
}

/// Patches on the six faces of a cuboid.
fn faces([low, high]: Part) -> Vec<Patch> {
    let mut all = Vec::new();
    for axis in 0..3 {
        let [a, b] = [(axis + 1) % 3, (axis + 2) % 3];
        let count = |k: usize| ((high[k] - low[k]) / EDGE_M).ceil().max(1.0);
        let (na, nb) = (count(a), count(b));
        for side in [low, high] {
            for i in 0..na as usize {
                for j in 0..nb as usize {
                    let (da, db) = ((high[a] - low[a]) / na, (high[b] - low[b]) / nb);
                    let mut patch = Patch {
                        place: [0.0; 3],
                        normal: [0.0; 3],
                        axes: [[0.0; 3]; 2],
                        smooth: true,
                        range_m: 10.0,
                        intensity: 0.2,
                        frame: 0,
                    };
                    patch.place[axis] = side[axis];
                    patch.place[a] = low[a] + (i as f32 + 0.5) * da;
                    patch.place[b] = low[b] + (j as f32 + 0.5) * db;
                    patch.normal[axis] = if side == low { -1.0 } else { 1.0 };
                    patch.axes[0][a] = 0.5 * da;
                    patch.axes[1][b] = 0.5 * db;
                    all.push(patch);
                }
            }
        }
    }
    all
}
