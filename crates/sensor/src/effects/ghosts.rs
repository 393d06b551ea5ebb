//! D2: light that takes a way round by a mirror.

use super::{Draws, FrameContext, Need, SensorEffect};
use crate::SimulateError;
use crate::error::within;
use crate::scan::{Scan, dot};
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// With probability `probability * lobe`, lobe the material's share of directed light, the return of a shot is not the surface's own but that of
/// what the surface mirrors: the point then lies behind the surface, at the range `R + L`, L the way from the surface to what is mirrored, m,
/// at most `longest_m`. Where the mirror shows nothing the return stays.
///
/// Typical: rare on paint and metal, frequent at glass fronts and wet roads (Waymo's issue 387; the data set Ghost-FWL).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Ghosts {
    /// 0 to 1, for a surface that mirrors all of the light.
    pub probability: f64,
    /// m.
    pub longest_m: f64,
}

impl Default for Ghosts {
    fn default() -> Self {
        Ghosts { probability: 0.02, longest_m: 60.0 }
    }
}

impl SensorEffect for Ghosts {
    fn check(&self) -> Result<(), SimulateError> {
        within("probability", self.probability, 0.0, 1.0)?;
        within("longest_m", self.longest_m, 0.0, 1000.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        None
    }

    fn on_scan(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        let Some(scene) = frame.scene else { return };
        let mut random = draws.of_frame();
        let mut mirrored = Vec::new();
        for (i, echo) in scan.echoes.iter().enumerate().filter(|(_, e)| e.is_return()) {
            let lobe = frame.materials.get(echo.material).lobe;
            if random.random_range(0.0..1.0) < self.probability * lobe {
                mirrored.push(i);
            }
        }
        let rays: Vec<([f32; 3], [f32; 3])> = mirrored.iter().map(|i| reflection(&scan.echoes[*i])).collect();
        for (i, surface) in mirrored.iter().zip(scene.cast(&rays)) {
            let echo = &mut scan.echoes[*i];
            if surface.range_m <= self.longest_m as f32 {
                echo.range_m += surface.range_m;
                echo.object = surface.object;
                echo.returned *= frame.materials.get(surface.material).returned(surface.cos_incidence.into()) as f32;
            }
        }
    }
}

/// The mirrored ray: from just before the surface, about its normal.
fn reflection(echo: &crate::scan::Echo) -> ([f32; 3], [f32; 3]) {
    let (point, n, d) = (echo.point(), echo.normal, echo.direction);
    let along = dot(n, d);
    let start = std::array::from_fn(|k| point[k] + 0.01 * n[k]);
    (start, std::array::from_fn(|k| d[k] - 2.0 * along * n[k]))
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;
    use crate::frame_scene::FrameScene;
    use crate::mesh::{Mesh, MaterialTable, cuboid};
    use crate::scan::Echo;
    use crate::scenario::Motion;
    use crate::world::{CarShape, World};
    use nalgebra::Vector3;

    #[test]
    fn points_lie_behind_the_mirror_as_far_as_what_it_shows() {
        // A metal wall ahead at 10 m, a concrete one behind at -5 m.
        let mut mesh = cuboid([10.0, -50.0, -50.0], [11.0, 50.0, 50.0], MaterialTable::built_in("metal")).of_object(4);
        mesh.append(&cuboid([-6.0, -50.0, -50.0], [-5.0, 50.0, 50.0], MaterialTable::built_in("concrete")).of_object(8));
        let (world, car, materials) = (World::new(&mesh), CarShape::new(&Mesh::default()), MaterialTable::default());
        let still = Motion { pose: geometry::Pose::identity(), velocity: Vector3::zeros(), turn_rate: Vector3::zeros() };
        let scene = FrameScene::new(&world, &car, &materials, still, &[]);
        let echo = Echo { range_m: 10.0, normal: [-1.0, 0.0, 0.0], material: MaterialTable::built_in("metal"), returned: 0.5, object: 4, ..Echo::nothing([0.0; 3], [1.0, 0.0, 0.0]) };
        let before = Scan { echoes: vec![echo; 5000] };
        let mut after = before.clone();
        let effect = Ghosts { probability: 0.5, longest_m: 60.0 };
        with_frame(0, |frame, draws| {
            let frame = FrameContext { scene: Some(&scene), rig: frame.rig, materials: frame.materials, cars: frame.cars, set: frame.set, ..*frame };
            effect.on_scan(&mut after, &frame, draws);
        });
        let ghosts: Vec<&Echo> = after.echoes.iter().filter(|e| e.range_m > 10.5).collect();
        let share = ghosts.len() as f64 / 5000.0;
        let lobe = materials.get(MaterialTable::built_in("metal")).lobe;
        assert!((share - 0.5 * lobe).abs() < 0.03, "{share}");
        assert!(ghosts.iter().all(|e| (e.range_m - 25.0).abs() < 0.03 && e.object == 8), "{:?}", ghosts[0]);
    }
}
