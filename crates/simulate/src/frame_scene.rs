//! Ray casting scene of one moment of the race: the static world, the cars at their poses, and the ego vehicle with
//! the sensors.

use crate::raycast::{Hit, Instance, Ray, Scene};
use crate::scenario::Motion;
use crate::world::{CarShape, World};
use geometry::Pose;
use nalgebra::{Matrix3, Point3, UnitQuaternion, Vector3};
use sensor::beams::{BeamWidth, Beams, Pick, SensorBeams};
use sensor::material::{MaterialId, MaterialTable};
use sensor::object::FIRST_CAR;
use sensor::scan::{Echo, Scan, dot};
use sensor::{RayCaster, Surface};

/// Ray casting scene of one cloud.
pub struct FrameScene<'a> {
    world: &'a World,
    car: &'a CarShape,
    materials: &'a MaterialTable,
    scene: Scene,
    ego: Motion,
}

impl<'a> FrameScene<'a> {
    /// `cars` are all cars except the ego vehicle, with their motion (the pose is `world_from_car`).
    pub fn new(
        world: &'a World,
        car: &'a CarShape,
        materials: &'a MaterialTable,
        ego: Motion,
        cars: &[Motion],
    ) -> FrameScene<'a> {
        let origin = Vector3::from(world.origin);
        let instance = |motion: &Motion| {
            let rotation = motion.pose.rotation.to_rotation_matrix();
            let row = |i: usize| [0, 1, 2].map(|k| rotation[(i, k)] as f32);
            let position = motion.pose.translation.vector - origin;
            Instance {
                shape: car.tree.clone(),
                rotation: [row(0), row(1), row(2)],
                position: position.map(|v| v as f32).into(),
                velocity: motion.velocity.map(|v| v as f32).into(),
            }
        };
        let scene = Scene::new(world.tree.clone(), cars.iter().map(instance).collect());
        FrameScene { world, car, materials, scene, ego }
    }

    /// `world_from_cloud` at the middle of the scan.
    pub fn world_from_cloud(&self) -> Pose {
        self.ego.pose
    }

    /// Simulates the scan of these shots.
    pub fn scan(&self, beams: &Beams) -> Scan {
        let mut scan = Scan { echoes: Vec::with_capacity(beams.shots()) };
        let mut seconds = Vec::new();
        // The true pose of the ego vehicle.
        let mut ego = self.ego;
        ego.pose.translation.vector += self.ego.pose.rotation * Vector3::z() * beams.ego_heave_m;
        ego.pose.rotation *= beams.ego_tilt;
        for (number, sensor) in beams.sensors.iter().enumerate() {
            let first = scan.echoes.len();
            self.nominal_shots(number, sensor, beams, &mut scan.echoes);
            let transform =
                RayTransform::new(&ego.pose, &sensor.true_mount, self.world.origin, beams.shutter.map(|_| &ego));
            let echoes = &mut scan.echoes[first..];
            match beams.width {
                None => self.cast_lines(sensor, &transform, echoes),
                Some(width) => self.cast_bundles(sensor, &transform, &width, echoes, &mut seconds),
            }
            for echo in echoes.iter_mut().chain(&mut seconds) {
                if !(sensor.limits_m[0]..=sensor.limits_m[1]).contains(&echo.range_m) {
                    echo.lose();
                }
            }
        }
        scan.echoes.extend(seconds.into_iter().filter(Echo::is_return));
        scan
    }

    /// Number of returns from each of `cars` cars, for thin beams that are fired at the same time. Equal to counting
    /// them in the scan, but casts those rays alone that come near a car.
    pub fn returns_of_cars(&self, beams: &Beams, cars: usize) -> Vec<usize> {
        let mut returns = vec![0; cars];
        for sensor in &beams.sensors {
            let transform = RayTransform::new(&self.ego.pose, &sensor.true_mount, self.world.origin, None);
            let rays = sensor.directions().iter().map(|direction| transform.ray(*direction, 0.0));
            let rays: Vec<Ray> = rays.filter(|ray| self.scene.may_hit_instance(ray)).collect();
            if rays.is_empty() {
                continue;
            }
            let mut hits = vec![Hit::MISS; rays.len()];
            self.scene.cast(&rays, rays.len(), &mut hits);
            let limits = sensor.limits_m[0]..=sensor.limits_m[1];
            for hit in hits.iter().filter(|hit| hit.is_hit() && hit.object > 0 && limits.contains(&hit.range_m)) {
                returns[hit.object as usize - 1] += 1;
            }
        }
        returns
    }

    /// The shots of a sensor with their nominal directions, without returns.
    fn nominal_shots(&self, number: usize, sensor: &SensorBeams, beams: &Beams, echoes: &mut Vec<Echo>) {
        let mount = &sensor.nominal_mount;
        let rotation: Matrix3<f32> = mount.rotation.to_rotation_matrix().matrix().map(|v| v as f32);
        let origin: Vector3<f32> = mount.translation.vector.map(|v| v as f32);
        let cloud_from_world = self.ego.pose.rotation.inverse();
        let velocity: Vector3<f32> = (cloud_from_world * self.ego.velocity).map(|v| v as f32);
        let turn_rate: Vector3<f32> = (cloud_from_world * self.ego.turn_rate).map(|v| v as f32);
        let deskewed = beams.shutter.is_some_and(|shutter| shutter.deskewed);
        for (shot, direction) in sensor.shots.iter().zip(sensor.nominal_directions.iter()) {
            let (mut origin, mut direction) = (origin, rotation * Vector3::from(*direction));
            if deskewed {
                let t = shot.time_s as f32;
                origin += (velocity + turn_rate.cross(&origin)) * t;
                direction = (direction + turn_rate.cross(&direction) * t).normalize();
            }
            echoes.push(Echo {
                sensor: number as u8,
                row: shot.row,
                column: shot.column,
                time_s: shot.time_s as f32,
                ..Echo::nothing(origin.into(), direction.into())
            });
        }
    }

    fn cast_lines(&self, sensor: &SensorBeams, transform: &RayTransform, echoes: &mut [Echo]) {
        let rays: Vec<Ray> =
            sensor.shots.iter().zip(sensor.directions()).map(|(s, d)| transform.ray(*d, s.time_s as f32)).collect();
        let mut hits = vec![Hit::MISS; rays.len()];
        self.scene.cast(&rays, sensor.columns, &mut hits);
        for ((hit, ray), echo) in hits.iter().zip(&rays).zip(echoes) {
            self.receive(echo, &self.surface(hit, ray));
        }
    }

    /// Casts every shot as a bundle of rays; returns are groups of surfaces within a pulse length.
    fn cast_bundles(
        &self,
        sensor: &SensorBeams,
        transform: &RayTransform,
        width: &BeamWidth,
        echoes: &mut [Echo],
        seconds: &mut Vec<Echo>,
    ) {
        let bundle = bundle(width);
        let ray = |(shot, direction): (&sensor::rig::Shot, &[f32; 3])| {
            let (direction, time_s) = (*direction, shot.time_s as f32);
            bundle.iter().map(move |(left, up, _)| transform.ray(sensor::beams::turned(direction, *left, *up), time_s))
        };
        let rays: Vec<Ray> = sensor.shots.iter().zip(sensor.directions()).flat_map(ray).collect();
        let mut hits = vec![Hit::MISS; rays.len()];
        self.scene.cast(&rays, rays.len().max(1), &mut hits);
        for (i, echo) in echoes.iter_mut().enumerate() {
            let here = i * bundle.len()..(i + 1) * bundle.len();
            let met = hits[here.clone()].iter().zip(&rays[here]).zip(&bundle).map(|((hit, ray), (_, _, weight))| {
                let surface = self.surface(hit, ray);
                let returned = self.materials.get(surface.material).returned(surface.cos_incidence.into()) as f32;
                (surface, weight * returned)
            });
            let groups = returns_of(met.filter(|(s, _)| s.range_m.is_finite()).collect(), width.pulse_m);
            let chosen = match width.pick {
                Pick::First => 0,
                Pick::Last => groups.len().saturating_sub(1),
                Pick::Strongest => strongest(&groups, None),
            };
            let Some((surface, light)) = groups.get(chosen) else { continue };
            self.receive(echo, surface);
            echo.returned = *light;
            if width.second && groups.len() > 1 {
                let mut second = Echo { number: 1, ..*echo };
                let (surface, light) = &groups[strongest(&groups, Some(chosen))];
                self.receive(&mut second, surface);
                second.returned = *light;
                seconds.push(second);
            }
        }
    }

    fn receive(&self, echo: &mut Echo, surface: &Surface) {
        if !surface.range_m.is_finite() {
            return;
        }
        let material = self.materials.get(surface.material);
        echo.range_m = surface.range_m;
        echo.normal = surface.normal;
        echo.cos_incidence = surface.cos_incidence;
        echo.material = surface.material;
        echo.object = surface.object;
        echo.reflectivity = material.reflectivity as f32;
        echo.returned = material.returned(surface.cos_incidence.into()) as f32;
        echo.intensity = echo.returned.min(1.0);
    }

    fn surface(&self, hit: &Hit, ray: &Ray) -> Surface {
        if !hit.is_hit() {
            return Surface {
                range_m: f32::INFINITY,
                normal: [0.0; 3],
                cos_incidence: 1.0,
                material: MaterialId(0),
                object: 0,
            };
        }
        let (material, object) = match hit.object {
            0 => self.world.surface(hit.triangle),
            k => (self.car.material(hit.triangle), FIRST_CAR + k as u16 - 1),
        };
        let rotation: UnitQuaternion<f32> = self.ego.pose.rotation.inverse().cast();
        Surface {
            range_m: hit.range_m,
            normal: (rotation * Vector3::from(hit.normal)).into(),
            cos_incidence: -dot(hit.normal, ray.direction).clamp(-1.0, 0.0),
            material,
            object,
        }
    }
}

impl RayCaster for FrameScene<'_> {
    fn cast(&self, rays: &[([f32; 3], [f32; 3])]) -> Vec<Surface> {
        let transform = RayTransform::new(&self.ego.pose, &Pose::identity(), self.world.origin, None);
        let world: Vec<Ray> = rays
            .iter()
            .map(|(origin, direction)| {
                let offset = transform.rotation * Vector3::from(*origin);
                let mut ray = transform.ray(*direction, 0.0);
                (0..3).for_each(|k| ray.origin[k] += offset[k]);
                ray
            })
            .collect();
        let mut hits = vec![Hit::MISS; rays.len()];
        if !rays.is_empty() {
            self.scene.cast(&world, rays.len(), &mut hits);
        }
        hits.iter().zip(&world).map(|(hit, ray)| self.surface(hit, ray)).collect()
    }
}

/// Transform from a sensor frame to scene coordinates, at any time within the scan.
struct RayTransform {
    origin: Vector3<f32>,
    rotation: Matrix3<f32>,
    /// Velocity and angular velocity of the sensor, scene axes.
    motion: Option<(Vector3<f32>, Vector3<f32>)>,
}

impl RayTransform {
    fn new(
        world_from_cloud: &Pose,
        cloud_from_sensor: &Pose,
        scene_origin: [f64; 3],
        moving: Option<&Motion>,
    ) -> RayTransform {
        let world_from_sensor = world_from_cloud * cloud_from_sensor;
        let origin = (world_from_sensor * Point3::origin()).coords - Vector3::from(scene_origin);
        let motion = moving.map(|ego| {
            let lever = world_from_cloud.rotation * cloud_from_sensor.translation.vector;
            ((ego.velocity + ego.turn_rate.cross(&lever)).map(|v| v as f32), ego.turn_rate.map(|v| v as f32))
        });
        RayTransform {
            origin: origin.map(|v| v as f32),
            rotation: world_from_sensor.rotation.to_rotation_matrix().matrix().map(|v| v as f32),
            motion,
        }
    }

    fn ray(&self, direction: [f32; 3], time_s: f32) -> Ray {
        let mut direction = self.rotation * Vector3::from(direction);
        match self.motion {
            None => Ray { origin: self.origin.into(), direction: direction.into(), time_s: 0.0 },
            Some((velocity, turn_rate)) => {
                direction = (direction + turn_rate.cross(&direction) * time_s).normalize();
                Ray { origin: (self.origin + velocity * time_s).into(), direction: direction.into(), time_s }
            }
        }
    }
}

/// Offsets to the left and up (rad) and weights of the rays of a beam: the centre and one or two rings, weighted as a
/// Gaussian beam with intensity exp(-2) at the edge.
fn bundle(width: &BeamWidth) -> Vec<(f32, f32, f32)> {
    let half = width.divergence_rad / 2.0;
    let rings: &[(u32, f32)] = if width.rays > 7 { &[(1, 0.0), (6, 0.4), (12, 0.8)] } else { &[(1, 0.0), (6, 0.66)] };
    let rays = rings.iter().flat_map(|(n, radius)| {
        (0..*n).map(move |i| {
            let (s, c) = (std::f32::consts::TAU * (i as f32 + 0.25) / *n as f32).sin_cos();
            (half * radius * c, half * radius * s, (-2.0 * radius * radius).exp())
        })
    });
    let rays: Vec<_> = rays.collect();
    let sum: f32 = rays.iter().map(|r| r.2).sum();
    rays.into_iter().map(|(left, up, weight)| (left, up, weight / sum)).collect()
}

/// Groups surfaces without a gap of a pulse length between them, nearest first. Each group has the mean range and the
/// total light; its other attributes are those of its brightest ray.
fn returns_of(mut met: Vec<(Surface, f32)>, pulse_m: f32) -> Vec<(Surface, f32)> {
    met.sort_by(|a, b| a.0.range_m.total_cmp(&b.0.range_m));
    let mut groups = Vec::new();
    let mut begin = 0;
    for end in 1..=met.len() {
        if end < met.len() && met[end].0.range_m - met[end - 1].0.range_m <= pulse_m {
            continue;
        }
        let group = &met[begin..end];
        // A surface with zero reflectivity still has a range.
        let light: f32 = group.iter().map(|(s, l)| (l + 1e-12) / (s.range_m * s.range_m)).sum();
        let range_m = group.iter().map(|(s, l)| s.range_m * (l + 1e-12) / (s.range_m * s.range_m)).sum::<f32>() / light;
        let brightest = group.iter().max_by(|a, b| a.1.total_cmp(&b.1)).expect("a group has a surface").0;
        groups.push((Surface { range_m, ..brightest }, group.iter().map(|(_, l)| l).sum()));
        begin = end;
    }
    groups
}

/// Index of the group with the most light, excluding `but`.
fn strongest(groups: &[(Surface, f32)], but: Option<usize>) -> usize {
    let light = |i: usize| groups[i].1 / (groups[i].0.range_m * groups[i].0.range_m);
    // The nearest one if tied.
    (0..groups.len()).filter(|i| Some(*i) != but).rev().max_by(|a, b| light(*a).total_cmp(&light(*b))).unwrap_or(0)
}

#[cfg(test)]
mod tests;
