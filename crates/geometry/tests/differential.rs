//! The overlap against an independent polygon library, on random and on degenerate pairs of boxes.

use i_overlay::{
    core::{fill_rule::FillRule, overlay_rule::OverlayRule},
    float::overlay::FloatOverlay,
};
use lidarshift_geometry::{Box3, bev_intersection, bev_iou, iou_3d};
use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use std::f64::consts::{FRAC_PI_2, PI};

/// Area of the intersection by `i_overlay`, which rounds to a 64-bit grid; computed relative to the centre of `a` for
/// precision.
fn independent_intersection(a: &Box3, b: &Box3) -> f64 {
    let about = |c: &Box3| Box3 { center: std::array::from_fn(|i| c.center[i] - a.center[i]), ..*c }.bev_corners();
    let shapes = FloatOverlay::<[f64; 2], i64>::from_subj_and_clip(&about(a), &about(b))
        .overlay(OverlayRule::Intersect, FillRule::NonZero);
    let area = |contour: &Vec<[f64; 2]>| {
        let next = contour.iter().cycle().skip(1);
        contour.iter().zip(next).map(|(p, q)| p[0] * q[1] - p[1] * q[0]).sum::<f64>() / 2.0
    };
    shapes.iter().flatten().map(area).sum::<f64>().abs()
}

fn check(kind: &str, a: &Box3, b: &Box3) {
    let want = independent_intersection(a, b);
    let reach = a.size[0].max(a.size[1]).max(b.size[0]).max(b.size[1]);
    for (a, b) in [(a, b), (b, a)] {
        let got = bev_intersection(a, b);
        let limit = 1e-9 * reach * reach;
        assert!((got - want).abs() <= limit, "{kind}: {got} instead of {want}\n{a:?}\n{b:?}");
        let (bev, volume) = (bev_iou(a, b), iou_3d(a, b));
        assert!((0.0..=1.0).contains(&bev) && (0.0..=1.0).contains(&volume), "{kind}: {bev} {volume}");
        let union = a.size[0] * a.size[1] + b.size[0] * b.size[1] - want;
        assert!((bev - want / union).abs() <= 2.0 * limit / union, "{kind}: {bev} instead of {}", want / union);
    }
}

fn random_box(rng: &mut ChaCha8Rng) -> Box3 {
    let mut next = |low: f64, high: f64| rng.random_range(low..high);
    let center = [next(-40.0, 40.0), next(-40.0, 40.0), next(-1.0, 1.0)];
    Box3 { center, size: [next(0.3, 8.0), next(0.3, 4.0), next(0.5, 3.0)], yaw_rad: next(-7.0, 7.0) }
}

#[test]
fn random_pairs() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut meeting = 0;
    for _ in 0..12_000 {
        let a = random_box(&mut rng);
        let mut b = random_box(&mut rng);
        for axis in 0..2 {
            b.center[axis] = a.center[axis] + rng.random_range(-4.0..4.0);
        }
        check("random", &a, &b);
        meeting += usize::from(bev_intersection(&a, &b) > 0.0);
    }
    assert!(meeting > 6_000, "only {meeting} pairs meet");
}

#[test]
fn degenerate_pairs() {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    for round in 0..150 {
        let mut a = random_box(&mut rng);
        if round % 3 == 0 {
            a.yaw_rad = f64::from(round / 3 % 8) * FRAC_PI_2 / 2.0;
        }
        let [l, w, _] = a.size;
        let at = |x: f64, y: f64| Box3 { center: a.from_local([x, y, 0.0]), ..a };
        let turned = |angle: f64| Box3 { yaw_rad: a.yaw_rad + angle, ..a };
        let sized = |l: f64, w: f64| Box3 { size: [l, w, a.size[2]], ..a };
        let share = rng.random_range(0.01..0.99);
        let small = rng.random_range(-1e-6..1e-6);
        let pairs = [
            ("equal", a),
            ("turned by pi", turned(PI)),
            ("turned by 2 pi", turned(2.0 * PI)),
            ("turned by a quarter", turned(FRAC_PI_2)),
            ("turned a little", turned(small)),
            ("moved a little", at(small, -small)),
            ("edge on edge in front", at(l, 0.0)),
            ("edge on edge beside", at(0.0, w)),
            ("corner on corner", at(l, w)),
            ("collinear long edges", at(share * l, 0.0)),
            ("collinear short edges", at(0.0, share * w)),
            ("edge on part of an edge", at(l, share * w)),
            ("corner on edge", Box3 { yaw_rad: a.yaw_rad + PI / 4.0, ..at(l / 2.0 + (l + w) / 8f64.sqrt(), 0.0) }),
            ("nested", sized(share * l, share * w)),
            ("nested on the edges", Box3 { size: [l, share * w, 1.0], ..at(0.0, (1.0 - share) * w / 2.0) }),
            (
                "nested in a corner",
                Box3 { size: [share * l, share * w, 1.0], ..at((1.0 - share) * l / 2.0, (share - 1.0) * w / 2.0) },
            ),
            ("crossing", sized(w * share, l / share)),
            ("a sliver", Box3 { size: [l, 1e-7, 1.0], ..turned(share) }),
            ("a long sliver", Box3 { size: [1e4, 1e-3, 1.0], ..turned(share) }),
            ("huge", Box3 { size: [1e4, 1e4, 1.0], ..turned(share) }),
            ("tiny", Box3 { size: [1e-5, 1e-5, 1.0], ..at(share * l / 2.0, 0.0) }),
            ("tiny on the edge", Box3 { size: [1e-5, 1e-5, 1.0], ..at(l / 2.0, 0.0) }),
        ];
        for (kind, b) in &pairs {
            check(kind, &a, b);
            let far = |c: &Box3| Box3 { center: [c.center[0] + 4096.0, c.center[1] - 8192.0, c.center[2]], ..*c };
            check(kind, &far(&a), &far(b));
        }
    }
}
