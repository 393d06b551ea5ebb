use super::*;
use crate::raycast::Disc;
use crate::raycast::tree::pack;
use data::stream;
use proptest::prelude::*;
use rand::RngExt;

type Corners = [[f32; 3]; 3];

/// Intersects one ray with one triangle using the packet operations.
fn meet(ray: &Ray, corners: &Corners) -> Option<f32> {
    let t = pack(corners);
    let (o, d) = (ray.origin, ray.direction);
    let dot = |a: [f32; 3], b: [f32; 3]| a[2].mul_add(b[2], a[1].mul_add(b[1], a[0] * b[0]));
    let c: [f32; 3] = std::array::from_fn(|k| t.corner[k] - o[k]);
    let r = [d[1] * c[2] - d[2] * c[1], d[2] * c[0] - d[0] * c[2], d[0] * c[1] - d[1] * c[0]];
    let (u, v, det) = (dot(r, t.edge2), dot(r, t.edge1), dot(d, t.normal));
    let squared = det * det;
    let inside = 0.0 <= u * det && 0.0 <= v * det && (u + v) * det <= squared && 0.0 < squared;
    let range = dot(c, t.normal) / det;
    (inside && range >= 0.0).then_some(range)
}

/// Minimum of (range, triangle) over all triangles.
fn brute(ray: &Ray, corners: &[Corners]) -> Hit {
    let mut best = Hit::MISS;
    for (i, triangle) in corners.iter().enumerate() {
        if let Some(range_m) = meet(ray, triangle).filter(|r| *r < best.range_m) {
            best = Hit { range_m, triangle: i as u32, ..Hit::MISS };
        }
    }
    best
}

fn unit(v: [f32; 3]) -> [f32; 3] {
    let length = v.iter().map(|c| c * c).sum::<f32>().sqrt();
    v.map(|c| c / length)
}

/// A ground with two triangles per cell and boxes of random triangles above: many edges and corners are shared.
fn landscape(seed: u64, triangles: usize) -> Vec<Corners> {
    let mut random = stream(seed, "landscape", 0, 0);
    let height: Vec<f32> = (0..21 * 21).map(|_| random.random_range(-0.2..0.2)).collect();
    let ground = |i: usize, j: usize| [(i as f32 - 10.0) * 20.0, (j as f32 - 10.0) * 20.0, height[i * 21 + j] - 1.0];
    let mut all = Vec::new();
    for i in 0..20 {
        for j in 0..20 {
            let [a, b, c, d] = [ground(i, j), ground(i + 1, j), ground(i, j + 1), ground(i + 1, j + 1)];
            all.extend([[a, b, c], [b, d, c]]);
        }
    }
    for _ in 0..triangles {
        let middle: [f32; 3] =
            [random.random_range(-150.0..150.0), random.random_range(-150.0..150.0), random.random_range(-1.0..8.0)];
        all.push(std::array::from_fn(|_| middle.map(|m| m + random.random_range(-2.0..2.0))));
    }
    all
}

/// A scan of `rows` x `columns` from near the centre, with a moving origin.
fn scan_rays(seed: u64, rows: usize, columns: usize) -> Vec<Ray> {
    let mut random = stream(seed, "rays", 0, 0);
    let start: [f32; 3] = [random.random_range(-3.0..3.0), random.random_range(-3.0..3.0), 0.0];
    let ray = |i: usize| {
        let (row, column) = (i / columns, i % columns);
        let elevation = 0.2 - 0.5 * row as f32 / rows as f32;
        let azimuth = 6.2 * column as f32 / columns as f32;
        let direction = unit([azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin()]);
        let time_s = 0.05 * i as f32 / (rows * columns) as f32;
        Ray { origin: [start[0] + 60.0 * time_s, start[1], start[2]], direction, time_s }
    };
    (0..rows * columns).map(ray).collect()
}

fn sets() -> Vec<InstructionSet> {
    let all = [InstructionSet::Portable, InstructionSet::Avx2, InstructionSet::Avx512];
    all.into_iter().filter(|set| set.is_available()).collect()
}

fn cast(scene: &Scene, rays: &[Ray], columns: usize) -> Vec<Hit> {
    let mut hits = vec![Hit::MISS; rays.len()];
    scene.cast(rays, columns, &mut hits);
    hits
}

#[test]
fn equals_testing_every_triangle_to_the_bit() {
    let corners = landscape(1, 1500);
    let rays = scan_rays(2, 24, 101);
    let want: Vec<Hit> = rays.iter().map(|ray| brute(ray, &corners)).collect();
    assert!(want.iter().filter(|h| h.is_hit()).count() > 1000);
    let scene = Scene::new(Arc::new(Tree::new(&corners)), Vec::new());
    for set in sets() {
        for columns in [101, 1, rays.len(), 2] {
            if !rays.len().is_multiple_of(columns) {
                continue;
            }
            let got = cast(&scene.clone().with_instructions(set), &rays, columns);
            for (i, (got, want)) in got.iter().zip(&want).enumerate() {
                assert_eq!(got.range_m.to_bits(), want.range_m.to_bits(), "{set:?} ray {i}: {got:?} {want:?}");
                assert_eq!(got.triangle, want.triangle, "{set:?} ray {i}");
            }
        }
    }
}

#[test]
fn equal_ranges_go_to_the_lower_triangle() {
    let one: Corners = [[5.0, -1.0, -1.0], [5.0, 1.0, -1.0], [5.0, 0.0, 1.0]];
    let mut corners = landscape(3, 40);
    let first = corners.len() as u32;
    corners.extend([one, one, one]);
    let ray = Ray { origin: [0.0; 3], direction: [1.0, 0.0, 0.0], time_s: 0.0 };
    for set in sets() {
        let scene = Scene::new(Arc::new(Tree::new(&corners[first as usize..])), Vec::new()).with_instructions(set);
        assert_eq!(cast(&scene, &[ray; 3], 3)[1].triangle, 0);
    }
}

#[test]
fn threads_do_not_matter() {
    let corners = landscape(4, 3000);
    let rays = scan_rays(5, 64, 300);
    let scene = Scene::new(Arc::new(Tree::new(&corners)), Vec::new());
    let alone = cast(&scene, &rays, 300);
    for threads in [1, 2, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let mut hits = vec![Hit::MISS; rays.len()];
        pool.install(|| scene.cast_parallel(&rays, 300, &mut hits));
        assert!(hits == alone, "{threads} threads");
    }
}

#[test]
fn an_instance_is_its_moved_mesh() {
    let shape = landscape(6, 300).split_off(800);
    let (s, c) = 0.6_f32.sin_cos();
    let instance = Instance {
        shape: Arc::new(Tree::new(&shape)),
        rotation: [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]],
        position: [20.0, -5.0, 0.5],
        velocity: [40.0, 10.0, 0.0],
    };
    let ground = landscape(7, 0);
    let rays = scan_rays(8, 32, 200);
    let scene = Scene::new(Arc::new(Tree::new(&ground)), vec![instance.clone()]);
    let got = cast(&scene, &rays, 200);
    let on_instance = got.iter().filter(|h| h.object == 1).count();
    assert!(on_instance > 150, "{on_instance}");
    let mut compared = 0;
    for (i, ray) in rays.iter().enumerate().step_by(13) {
        let moved = shape.iter().map(|t| {
            t.map(|v| {
                let turned = turn(&instance.rotation, v);
                std::array::from_fn(|k| turned[k] + instance.position[k] + instance.velocity[k] * ray.time_s)
            })
        });
        let all: Vec<Corners> = ground.iter().copied().chain(moved).collect();
        let want = brute(ray, &all);
        let first = if got[i].object == 1 { ground.len() as u32 } else { 0 };
        // A ray that grazes an edge may hit in one arithmetic and miss in the other.
        if want.is_hit() && got[i].is_hit() && got[i].triangle + first == want.triangle {
            assert!((got[i].range_m - want.range_m).abs() < 2e-3, "{:?} {want:?}", got[i]);
            compared += 1;
        }
        assert_eq!(want.is_hit(), got[i].is_hit());
    }
    let hit = got.iter().step_by(13).filter(|h| h.is_hit()).count();
    assert!(compared * 100 >= hit * 99, "{compared} of {hit} hit the same triangle");
    for set in sets() {
        assert!(cast(&scene.clone().with_instructions(set), &rays, 200) == got, "{set:?}");
    }
}

#[test]
fn normals_face_the_ray() {
    let corners = landscape(9, 500);
    let rays = scan_rays(10, 16, 64);
    let scene = Scene::new(Arc::new(Tree::new(&corners)), Vec::new());
    for (ray, hit) in rays.iter().zip(cast(&scene, &rays, 64)).filter(|(_, h)| h.is_hit()) {
        let along: f32 = (0..3).map(|k| hit.normal[k] * ray.direction[k]).sum();
        let length: f32 = hit.normal.iter().map(|v| v * v).sum();
        assert!(along <= 0.0 && (length - 1.0).abs() < 1e-5);
    }
}

#[test]
fn nothing_to_hit_and_triangles_that_are_none() {
    let ray = Ray { origin: [0.0; 3], direction: [1.0, 0.0, 0.0], time_s: 0.0 };
    let empty = Scene::new(Arc::new(Tree::new(&[])), Vec::new());
    assert_eq!(cast(&empty, &[ray], 1), [Hit::MISS]);
    let wall: Corners = [[5.0, -1.0, -1.0], [5.0, 1.0, -1.0], [5.0, 0.0, 1.0]];
    let point: Corners = [[3.0, 0.0, 0.0]; 3];
    let line: Corners = [[3.0, -1.0, 0.0], [3.0, 0.0, 0.0], [3.0, 1.0, 0.0]];
    let mut broken = wall;
    broken[1][2] = f32::NAN;
    let scene = Scene::new(Arc::new(Tree::new(&[point, line, broken, wall])), Vec::new());
    assert_eq!(scene.ground.len(), 3);
    let hit = cast(&scene, &[ray], 1)[0];
    assert_eq!((hit.range_m, hit.triangle), (5.0, 3));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Axis-parallel rays through corners of the grid: zero-width slabs and components of exactly 0.
    #[test]
    fn axis_parallel_rays_are_hit_as_any_other(seed in 0_u64..1000, axis in 0_usize..3, sign in prop::bool::ANY, steps in prop::array::uniform3(-8_i32..8)) {
        let corners = landscape(seed, 60);
        let mut direction = [0.0; 3];
        direction[axis] = if sign { 1.0 } else { -1.0 };
        let origin = [steps[0] as f32 * 20.0, steps[1] as f32 * 20.0, steps[2] as f32 * 0.5];
        let ray = Ray { origin, direction, time_s: 0.0 };
        let scene = Scene::new(Arc::new(Tree::new(&corners)), Vec::new());
        let want = brute(&ray, &corners);
        for set in sets() {
            let got = cast(&scene.clone().with_instructions(set), &[ray; 5], 5)[3];
            prop_assert_eq!(got.range_m.to_bits(), want.range_m.to_bits());
            prop_assert_eq!(got.triangle, want.triangle);
        }
    }
}

/// Random discs, and where a ray meets each: range, and squared distance from the centre in half axes (f64).
fn discs(seed: u64, count: usize) -> Vec<Disc> {
    let mut random = stream(seed, "discs", 0, 0);
    let mut vector = |size: f32| -> [f32; 3] { std::array::from_fn(|_| random.random_range(-size..size)) };
    (0..count).map(|_| Disc { centre: vector(60.0), axes: [vector(2.0), vector(2.0)] }).collect()
}

fn meet_disc(ray: &Ray, disc: &Disc) -> Option<(f64, f64)> {
    let v = |a: [f32; 3]| nalgebra::Vector3::from(a.map(f64::from));
    let [a, b] = disc.axes.map(v);
    let (normal, from) = (a.cross(&b), v(disc.centre) - v(ray.origin));
    let range = normal.dot(&from) / normal.dot(&v(ray.direction));
    let off = v(ray.direction) * range - from;
    // Coordinates of the place in half axes.
    let [s, t] =
        [b.cross(&normal).dot(&off) / b.cross(&normal).dot(&a), a.cross(&normal).dot(&off) / a.cross(&normal).dot(&b)];
    (range >= 0.0).then_some((range, s * s + t * t))
}

#[test]
fn discs_are_hit_where_their_ellipses_are() {
    let discs = discs(5, 3000);
    let rays = scan_rays(6, 16, 100);
    let tree = Arc::new(Tree::of_discs(&discs));
    let (mut inside, mut met) = (0, 0);
    for set in sets() {
        let hits = cast(&Scene::new(tree.clone(), vec![]).with_instructions(set), &rays, 100);
        for (ray, hit) in rays.iter().zip(&hits) {
            let all: Vec<(f64, f64)> = discs.iter().filter_map(|d| meet_disc(ray, d)).collect();
            // Borders are rounded; a ray within 1e-3 of one may pass on either side.
            let sure = all.iter().filter(|(_, q)| *q < 0.999).map(|m| m.0).fold(f64::INFINITY, f64::min);
            let maybe = all.iter().filter(|(_, q)| *q < 1.001).map(|m| m.0).fold(f64::INFINITY, f64::min);
            let range = f64::from(hit.range_m);
            assert!(range <= sure + 1e-2 && range >= maybe - 1e-2, "{range} {sure} {maybe}");
            inside += usize::from(hit.is_hit());
        }
    }
    for ray in &rays {
        let mut found = Vec::new();
        tree.through(ray.origin, ray.direction, 1000.0, |id, range, off| {
            found.push((id, range, off));
            f32::INFINITY
        });
        for (id, range, off) in &found {
            let (want, q) = meet_disc(ray, &discs[*id as usize]).expect("the disc is met");
            assert!((f64::from(*range) - want).abs() < 1e-2 && (f64::from(*off) - q).abs() < 2e-2, "{off} {q}");
        }
        met += found.len();
        let sure = discs.iter().filter_map(|d| meet_disc(ray, d)).filter(|m| m.1 < 0.999).count();
        assert!(found.len() >= sure, "{} of {sure}", found.len());
    }
    assert!(inside > 300 && met > 300, "{inside} {met}");
}
