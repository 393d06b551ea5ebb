//! What each effect does to a frame.

use crate::case::{Case, Kind, draw_case};
use crate::clutter::Law;
use crate::draw::{CAUSES, OFF_CATALOGUE, draw_effect};
use crate::effect::{Clock, Dark, Effect, Spot};
use crate::frame::{Echo, Frame};
use crate::oracle::judge;
use crate::sensor::Shot;
use crate::side::{POSE_STD, Side};
use crate::solid::Material;
use crate::world::Object;
use nalgebra::{Point3, Vector3};
use score::CaseSize;

/// A case of a roof sensor without effects.
fn case() -> Case {
    (1..60)
        .map(|seed| draw_case(seed, Kind::Null, CaseSize { frames: 4, shots: 6_000 }))
        .find(|case| case.measured.setting.layout == crate::sensor::Layout::Roof(32))
        .unwrap()
}

fn with(case: &Case, effect: Effect) -> Side {
    case.measured.with_effects(&case.real_world, vec![effect])
}

fn shot(azimuth_deg: f64, elevation_deg: f64, phase: f64) -> Shot {
    let [azimuth_rad, elevation_rad] = [azimuth_deg, elevation_deg].map(f64::to_radians);
    Shot { sensor: 0, row: 0, column: 0, azimuth_rad, elevation_rad, phase }
}

/// A surface of 30 % that is met 20 m ahead at an angle of incidence.
fn echo(cos_incidence: f64, material: Material, object: Object) -> Echo {
    Echo {
        range_m: 20.0,
        cos_incidence,
        reflectivity: 0.3,
        material,
        object,
        normal: -Vector3::x(),
        ray: Vector3::x(),
        origin: Point3::origin(),
    }
}

fn wall() -> Echo {
    echo(1.0, Material::Plaster, Object::House(0))
}

/// Share of the usual returns that an effect leaves.
fn kept(case: &Case, effect: Effect, shot: &Shot, echo: &Echo) -> f64 {
    let side = with(case, effect);
    Frame::new(&side, 1).kept(shot, echo) / Frame::new(&case.measured, 1).kept(shot, echo)
}

#[test]
fn losses_keep_what_their_law_says() {
    let case = case();
    let (here, wall) = (shot(10.0, -2.0, 0.0), wall());
    let signal = wall.signal();
    let near = |found: f64, want: f64| assert!((found - want).abs() < 0.03, "{found}, not {want}");
    near(kept(&case, Effect::RandomDropout { share: 0.2 }, &here, &wall), 0.8);
    near(kept(&case, Effect::SignalDropout { half_at: signal, steepness: 2.0 }, &here, &wall), 0.5);
    near(kept(&case, Effect::SignalDropout { half_at: signal - 3.0, steepness: 2.0 }, &here, &wall), 1.0);
    near(kept(&case, Effect::RangeDropout { half_at_m: 20.0, softness_m: 5.0 }, &here, &wall), 0.5);
    near(kept(&case, Effect::RangeDropout { half_at_m: 25.0, softness_m: 5.0 }, &here, &wall), 0.84);
    let grazing = echo(0.1, Material::Plaster, Object::House(0));
    near(kept(&case, Effect::IncidenceDropout { cos_half: 0.1, power: 1.0 }, &here, &grazing), 0.5);
    near(kept(&case, Effect::IncidenceDropout { cos_half: 0.1, power: 1.0 }, &here, &wall), 1.0);
    near(kept(&case, Effect::RangeCut { max_m: 19.0 }, &here, &wall), 0.0);
    near(kept(&case, Effect::RangeCut { max_m: 21.0 }, &here, &wall), 1.0);
    near(kept(&case, Effect::RangeLimits { min_m: 21.0 }, &here, &wall), 0.0);
    let spot = Spot { sensor: 0, center: [here.azimuth_rad, here.elevation_rad], radius: [0.1, 0.05] };
    let dirt = |spot| Effect::DirtyWindow { spot, share: 0.6, noise_m: 0.02 };
    near(kept(&case, dirt(spot), &here, &wall), 0.4);
    near(kept(&case, dirt(spot), &shot(10.0 + 0.1f64.to_degrees(), -2.0, 0.0), &wall), 0.7);
    let tyre = echo(1.0, Material::Rubber, Object::Vehicle(0));
    let body = echo(1.0, Material::Paint, Object::Vehicle(0));
    let dark = |dark| Effect::MaterialDropout { dark, share: 0.7 };
    near(kept(&case, dark(Dark::Tyres), &here, &tyre), 0.3);
    near(kept(&case, dark(Dark::Tyres), &here, &body), 1.0);
    near(kept(&case, dark(Dark::Bodies), &here, &body), 0.3);
    let columns = |column| Shot { column, ..here };
    let every = Effect::ColumnLoss { share: 0.5, every: 4 };
    near(kept(&case, every.clone(), &columns(8), &wall), 0.5);
    near(kept(&case, every, &columns(9), &wall), 1.0);
}

#[test]
fn fog_and_rain_attenuate() {
    let case = case();
    let fog = with(&case, Effect::Fog { visibility_m: 300.0, backscatter: 0.01 });
    assert!((Frame::new(&fog, 0).attenuation(50.0) - 2.0 * 50.0 * 3.0 / 300.0).abs() < 1e-9);
    let rain = with(&case, Effect::Rain { drops: 0.01, per_m: 0.002 });
    assert!((Frame::new(&rain, 0).attenuation(50.0) - 0.2).abs() < 1e-9);
}

#[test]
fn packets_are_lost_in_runs_of_whole_packets() {
    let case = case();
    let side = with(&case, Effect::PacketLoss { loss: 0.1, burst: 0.6 });
    let lost: Vec<bool> = (0..4).flat_map(|i| Frame::new(&side, i).lost.concat()).collect();
    let share = lost.iter().filter(|l| **l).count() as f64 / lost.len() as f64;
    assert!((0.0..0.35).contains(&share), "{share}");
    let frame = (0..4).map(|i| Frame::new(&side, i)).find(|f| f.lost[0].contains(&true)).unwrap();
    let packet = frame.lost[0].iter().position(|l| *l).unwrap();
    let inside = Shot { column: packet * crate::frame::PACKET + 3, ..shot(0.0, 0.0, 0.0) };
    assert_eq!(frame.kept(&inside, &wall()), 0.0);
}

#[test]
fn ranges_are_shifted_as_their_law_says() {
    let case = case();
    let (here, wall) = (shot(10.0, -2.0, 0.0), wall());
    let shift = |effect: Effect, index: usize, shot: &Shot, echo: &Echo| {
        let side = with(&case, effect);
        Frame::new(&side, index).shift_m(shot, echo) - Frame::new(&case.measured, index).shift_m(shot, echo)
    };
    let near = |found: f64, want: f64| assert!((found - want).abs() < 1e-3, "{found}, not {want}");
    near(shift(Effect::RangeBias { offset_m: 0.1, scale: 0.0 }, 1, &here, &wall), 0.1);
    near(shift(Effect::RangeBias { offset_m: 0.0, scale: 0.002 }, 1, &here, &wall), 0.04);
    let bright = Echo { reflectivity: 0.9, ..wall };
    let walk = Effect::ReflectivityWalk { walk_m: 0.03 };
    assert!(shift(walk.clone(), 1, &here, &bright) < shift(walk.clone(), 1, &here, &wall) - 0.01);
    near(shift(walk, 1, &here, &Echo { reflectivity: 0.25, ..wall }), 0.0);
    let drift = Effect::RangeDrift { drift_m: 0.1 };
    near(shift(drift.clone(), 0, &here, &wall), 0.0);
    assert!(shift(drift.clone(), 3, &here, &wall) > shift(drift, 1, &here, &wall) + 0.02);
    let rows = Effect::ThermalRows { drift_m: 0.1 };
    let odd = Shot { row: 1, ..here };
    near(shift(rows.clone(), 2, &here, &wall) + shift(rows, 2, &odd, &wall), 0.0);
    let ripple = Effect::RangeRipple { amplitude_m: 0.05, length_m: 2.0 };
    near(shift(ripple.clone(), 1, &here, &Echo { range_m: 20.5, ..wall }), 0.05);
    near(shift(ripple, 1, &here, &Echo { range_m: 21.0, ..wall }), 0.0);
    let side = with(&case, Effect::BeamRangeOffset { std_m: 0.04 });
    let frame = Frame::new(&side, 1);
    let offsets: Vec<f64> = (0..32).map(|row| frame.shift_m(&Shot { row, ..here }, &wall)).collect();
    let mean = offsets.iter().sum::<f64>() / 32.0;
    near((offsets.iter().map(|o| (o - mean).powi(2)).sum::<f64>() / 32.0).sqrt(), 0.04);
}

#[test]
fn ranges_scatter_as_their_law_says() {
    let case = case();
    let (here, wall) = (shot(10.0, -2.0, 0.0), wall());
    let added = |effect: Effect, echo: &Echo| {
        let side = with(&case, effect);
        let [all, usual] = [&side, &case.measured].map(|s| Frame::new(s, 1).scatter(&here, echo).variance_m2());
        (all - usual).sqrt()
    };
    let near = |found: f64, want: f64| assert!((found - want).abs() < 1e-6, "{found}, not {want}");
    near(added(Effect::RangeNoise { std_m: 0.03, growth: 0.0 }, &wall), 0.03);
    near(added(Effect::RangeNoise { std_m: 0.03, growth: 0.002 }, &wall), 0.05);
    let u = wall.signal() - (0.1f64 / 62_500.0).ln();
    let far = Echo { range_m: 20.0 * ((u - 4.0) / 2.0).exp(), ..wall };
    near(added(Effect::SignalNoise { std_m: 0.02, growth: 0.5 }, &far), 0.02);
    let inclined = echo(0.5, Material::Plaster, Object::House(0));
    near(added(Effect::IncidenceNoise { angle_rad: 1e-3 }, &inclined), 0.02 * 3f64.sqrt());
    near(added(Effect::HeavyTails { share: 0.04, std_m: 0.2 }, &wall), 0.04);
}

#[test]
fn directions_and_poses_move_what_is_met() {
    let case = case();
    let range = |side: &Side, shot: &Shot| Frame::new(side, 1).trace(shot, [0.0; 2]).first.map_or(0.0, |e| e.range_m);
    let plain = &case.measured;
    let down = |azimuth: f64| shot(azimuth, -16.0, 0.0);
    // Nose down: the ground ahead is nearer, that behind farther. Left side up: rays to the right go farther down.
    let pitched = with(&case, Effect::PitchRoll { pitch_rad: 0.02, roll_rad: 0.0 });
    let rolled = with(&case, Effect::PitchRoll { pitch_rad: 0.0, roll_rad: 0.02 });
    assert!(range(&pitched, &down(0.0)) < range(plain, &down(0.0)) - 0.1);
    assert!(range(&pitched, &down(180.0)) > range(plain, &down(180.0)) + 0.1);
    let rise = |side: &Side| Frame::new(side, 1).trace(&down(-90.0), [0.0; 2]).first.unwrap().ray.z;
    assert!((rise(plain) - rise(&rolled) - 0.02 * 16f64.to_radians().cos()).abs() < 2e-3);
    // Beams that truly point higher meet the ground farther away.
    let high = with(&case, Effect::BeamElevationOffset { std_rad: 0.01 });
    for row in 0..32 {
        let shot = Shot { row, ..down(0.0) };
        let (error, farther) = (high.rows[0][row].elevation_rad, range(&high, &shot) - range(plain, &shot));
        assert!(error.abs() < 2e-3 || error * farther > 0.0, "row {row}: {error} {farther}");
    }
    let turned = Effect::SensorExtrinsics { sensor: 0, turn_rad: [0.0, 0.02, 0.0], shift_m: [0.0; 3] };
    assert!(range(&with(&case, turned), &down(0.0)) < range(plain, &down(0.0)) - 0.1);
    let speed = case.measured.scenario.drive.speed_m_s(case.measured.setting.step_s());
    let attitude = with(&case, Effect::EgoAttitude { pitch_rad: 0.02 * (10.0 / speed).powi(2) });
    assert!((range(&attitude, &down(0.0)) - range(&pitched, &down(0.0))).abs() < 1e-3);
}

#[test]
fn a_scan_takes_its_time_and_a_mount_nods() {
    let case = case();
    let step = case.measured.setting.step_s();
    let side = with(&case, Effect::RollingShutter { scan_s: 0.08 });
    let frame = Frame::new(&side, 1);
    let origin = |phase: f64| frame.trace(&shot(0.0, -16.0, phase), [0.0; 2]).first.unwrap().origin;
    let driven = side.scenario.drive.distance_m(step + 0.04) - side.scenario.drive.distance_m(step - 0.04);
    let moved = (origin(0.499) - origin(-0.499)).norm();
    assert!((moved / driven - 1.0).abs() < 0.1, "{moved} {driven}");
    let side = with(&case, Effect::MountVibration { amplitude_rad: 0.01, hz: 7.0 });
    let frame = Frame::new(&side, 2);
    let up = |phase: f64| frame.trace(&shot(0.0, -16.0, phase), [0.0; 2]).first.unwrap().ray.z;
    let nods: Vec<f64> = (-10..10).map(|i| up(f64::from(i) / 20.0)).collect();
    let range = nods.iter().fold(f64::MIN, |a, b| a.max(*b)) - nods.iter().fold(f64::MAX, |a, b| a.min(*b));
    assert!((0.003..0.021).contains(&range), "{range}");
    let side = with(&case, Effect::EncoderRipple { amplitude_rad: 0.004, waves: 3.0 });
    let frame = Frame::new(&side, 1);
    let straight = Frame::new(&case.measured, 1);
    let angles = (0..36).map(|i| {
        let shot = shot(10.0 * f64::from(i) - 175.0, -16.0, 0.0);
        let [a, b] = [&frame, &straight].map(|f| f.trace(&shot, [0.0; 2]).first.unwrap().ray);
        a.dot(&b).clamp(-1.0, 1.0).acos()
    });
    let most = angles.fold(0.0, f64::max);
    assert!((most / (0.004 * 16f64.to_radians().cos()) - 1.0).abs() < 0.1, "{most}");
}

#[test]
fn worlds_differ_as_they_should() {
    let case = case();
    let real = &case.real_world;
    let side = with(&case, Effect::MissingObject { things: 5, surplus: false });
    assert_eq!(side.world.bodies.len(), real.bodies.len() + 5);
    let side = with(&case, Effect::MissingObject { things: 5, surplus: true });
    let buried = (0..real.vehicles.len()).filter(|&v| side.world.place(v, 0.0).center[2] < -10.0).count();
    assert!((1..=5).contains(&buried), "{buried}");
    let side = with(&case, Effect::WrongShape { length: 0.1, height: 0.2 });
    for (model, usual) in side.world.models.iter().zip(&real.models).filter(|m| m.0.class == "Car") {
        assert!((model.stretch[0] / usual.stretch[0] - 1.1).abs() < 1e-9 && model.size_m == usual.size_m);
        assert!((model.stretch[2] / usual.stretch[2] - 1.2).abs() < 1e-9 && model.stretch[1] == usual.stretch[1]);
    }
    let side = with(&case, Effect::GroundError { amplitude_m: 0.05 });
    let off = (0..200).map(|i| {
        let p = Point3::new(real.corners[0][0] + 50.0 + f64::from(i), real.corners[0][1] + 60.0, 0.0);
        (side.world.streets.height_m(p.x, p.y) - real.streets.height_m(p.x, p.y)).abs()
    });
    let most = off.fold(0.0, f64::max);
    assert!((0.01..=0.05).contains(&most), "{most}");
    let side = with(&case, Effect::WavyWalls { amplitude_m: 0.05, length_m: 6.0 });
    assert!(side.world.houses.iter().all(|h| h.wave.is_some()) && real.houses.iter().all(|h| h.wave.is_none()));
    let center_m = case.measured.mounts[0].position_m;
    let rack = Effect::EgoOcclusion {
        center_m: [center_m[0] - 1.0, center_m[1], center_m[2]],
        size_m: [0.2; 3],
        returns: true,
    };
    let side = with(&case, rack);
    let met = Frame::new(&side, 1).trace(&shot(180.0, 0.0, 0.0), [0.0; 2]).first.unwrap();
    assert!(met.object == Object::Ego && (met.range_m - 0.9).abs() < 1e-9);
}

#[test]
fn labels_are_late_or_shifted_in_the_frame_of_the_object() {
    let case = case();
    let vehicle = case.measured.world.vehicles.len() - 20;
    let moving = (0..case.measured.world.vehicles.len())
        .find(|&v| case.measured.world.vehicles[v].motion.velocity_m_s(0.5, &case.measured.world.streets).norm() > 3.0)
        .unwrap();
    let usual = Frame::new(&case.measured, 1);
    let side = with(&case, Effect::LabelOffset { offset_m: [0.3, -0.1, 0.05] });
    for v in [vehicle, moving] {
        let local = usual.label_box(v, [0.0; 3]).to_local(Frame::new(&side, 1).label_box(v, [0.0; 3]).center);
        assert!((0..3).all(|k| (local[k] - [0.3, -0.1, 0.05][k]).abs() < 0.01), "{local:?}");
    }
    let velocity = case.measured.world.vehicles[moving].motion.velocity_m_s(usual.time_s, &case.measured.world.streets);
    for clock in [Clock::Objects, Clock::Cloud] {
        let side = with(&case, Effect::TimeOffset { seconds: 0.05, clock });
        let late = Frame::new(&side, 1);
        let apart = |a: &Frame, b: &Frame, v: usize| {
            let [a, b] = [a, b].map(|f| Vector3::from(f.label_box(v, [0.0; 3]).center));
            (a - b).norm()
        };
        let of_parked = apart(&late, &usual, 0);
        match clock {
            Clock::Objects => {
                assert!((apart(&late, &usual, moving) / (0.05 * velocity.norm()) - 1.0).abs() < 0.05);
                assert!(of_parked < 1e-9);
            }
            Clock::Cloud => assert!(of_parked > 0.01),
        }
    }
}

#[test]
fn returns_from_elsewhere_have_their_rate_and_place() {
    let case = case();
    let (here, wall) = (shot(10.0, -2.0, 0.0), wall());
    let rate = |effect: Effect| {
        let side = with(&case, effect);
        let ways = Frame::new(&side, 1).clutter(&here, Some(&wall));
        ways.iter().map(|w| w.rate).sum::<f64>()
    };
    assert_eq!(rate(Effect::Outliers { share: 0.02, reach_m: 90.0 }), 0.02);
    assert_eq!(rate(Effect::Rain { drops: 0.01, per_m: 0.001 }), 0.01);
    assert_eq!(rate(Effect::Fog { visibility_m: 200.0, backscatter: 0.03 }), 0.03);
    let side = with(&case, Effect::Interference { share: 0.2, stripes: 5.0 });
    let frame = Frame::new(&side, 1);
    let struck = (0..360).filter(|i| !frame.clutter(&shot(f64::from(*i), 0.0, 0.0), None).is_empty()).count();
    assert!((20..90).contains(&struck), "a stripe covers about a seventh: {struck}");
    // Ghosts are behind the glass that mirrors.
    let side = with(&case, Effect::Ghosts { probability: 0.3 });
    let frame = Frame::new(&side, 1);
    let mut ghosts = 0;
    for i in 0..720 {
        let shot = shot(0.5 * f64::from(i) - 180.0, 2.0, 0.0);
        let Some(echo) = frame.trace(&shot, [0.0; 2]).first else { continue };
        for way in frame.clutter(&shot, Some(&echo)) {
            let Law::At(range) = way.law else { panic!("{way:?}") };
            assert!(range > echo.range_m && matches!(echo.material, Material::Glass | Material::Paint));
            ghosts += 1;
        }
    }
    assert!(ghosts > 5, "{ghosts}");
}

#[test]
fn bright_signs_have_halos_and_blind_what_is_beside_them() {
    let case = (1..40)
        .map(|seed| draw_case(seed, Kind::Null, CaseSize { frames: 4, shots: 6_000 }))
        .find(|case| {
            let side = with(case, Effect::Blooming { strength: 0.8, halo_rad: 0.02 });
            !Frame::new(&side, 1).bright[0].is_empty()
        })
        .unwrap();
    let side = with(&case, Effect::Blooming { strength: 0.8, halo_rad: 0.02 });
    let frame = Frame::new(&side, 1);
    let bright = frame.bright[0][0];
    let beside = |off_rad: f64| {
        let d = bright.direction;
        let (azimuth, elevation) = (d.y.atan2(d.x).to_degrees(), d.z.asin().to_degrees());
        shot(azimuth, elevation + (bright.half_rad + off_rad).to_degrees(), 0.0)
    };
    let behind = Echo { range_m: bright.range_m + 30.0, ..wall() };
    let way = frame.clutter(&beside(0.02), Some(&behind))[0];
    assert!(way.law == Law::At(bright.range_m) && (way.rate / (0.8 / 1f64.exp()) - 1.0).abs() < 0.3, "{way:?}");
    let in_front = Echo { range_m: (bright.range_m - 2.0).max(1.0), ..wall() };
    assert!(frame.clutter(&beside(0.02), Some(&in_front)).iter().all(|w| w.law != Law::At(bright.range_m)));
    let side = with(&case, Effect::BrightTargetDropout { share: 0.8, halo_rad: 0.02 });
    let (lost, usual) = (Frame::new(&side, 1), Frame::new(&case.measured, 1));
    let share = |off: f64| lost.kept(&beside(off), &behind) / usual.kept(&beside(off), &behind);
    assert!(share(1e-4) < 0.3 && share(0.1) > 0.9, "{} {}", share(1e-4), share(0.1));
}

#[test]
fn scans_show_rounding_second_returns_and_gains() {
    let case = case();
    let points = |side: &Side| Frame::new(side, 1).scan().points;
    let side = with(&case, Effect::Quantisation { step_m: 0.1 });
    let origin = case.measured.mounts[0].position_m;
    let on_comb = points(&side).into_iter().filter(|p| {
        let range = (0..3).map(|k| (f64::from(p[k]) - origin[k]).powi(2)).sum::<f64>().sqrt();
        let steps = range / 0.1;
        (steps - steps.round()).abs() < 1e-3
    });
    let share = on_comb.count() as f64 / points(&side).len() as f64;
    assert!((0.94..0.995).contains(&share), "{share}");
    let side = with(&case, Effect::DualReturns { divergence_rad: 6e-3, share: 1.0 });
    assert!(points(&side).len() > points(&case.measured).len() + 10);
    let side = with(&case, Effect::BeamIntensity { std: 0.2 });
    let gains: std::collections::BTreeSet<u64> =
        Frame::new(&side, 1).scan().lights.iter().map(|l| l.gain.to_bits()).collect();
    assert_eq!(gains.len(), 32);
}

#[test]
fn an_oracle_knows_no_more_than_the_nuisances_let_it() {
    let case = case();
    let judged = |effect: Effect| {
        let measured = with(&case, effect);
        judge(&Case { measured, ..case.clone() }).remove(0)
    };
    // Four frames whose pitch is known to 1e-4 rad each, less well where they follow each other closely.
    let pitched = judged(Effect::PitchRoll { pitch_rad: 0.005, roll_rad: 0.0 });
    let least = (0.8 * POSE_STD[1] / 2.0).to_degrees();
    assert!((least..10.0 * least).contains(&pitched.bound["pitch_deg"]), "{pitched:?}");
    assert!((0.005f64.to_degrees() / pitched.bound["pitch_deg"]) < 1.05 * pitched.strength);
    let noise = |std_m: f64| judged(Effect::RangeNoise { std_m, growth: 0.0 });
    assert!(noise(0.001).strength < 8.0 && noise(0.05).strength > 40.0);
    let share = judged(Effect::RandomDropout { share: 0.1 });
    let per_return = (0.1 * 0.9 / (4.0 * 6_000.0f64)).sqrt();
    assert!((per_return..5.0 * per_return).contains(&share.bound["share"]), "{share:?}");
    assert!((share.touched / 2_000.0 - 1.0).abs() < 0.4, "{share:?}");
    let both = case.measured.with_effects(
        &case.real_world,
        vec![Effect::LabelOffset { offset_m: [0.2, 0.0, 0.0] }, Effect::RangeBias { offset_m: 0.1, scale: 0.0 }],
    );
    let both = judge(&Case { measured: both, ..case.clone() });
    assert!(both.len() == 2 && both[0].bound.contains_key("forward_m") && both[1].bound.contains_key("offset_m"));
}

/// Every effect changes the scan; the same effect gives the same scan.
#[test]
fn every_effect_has_an_effect() {
    let case = (1..60)
        .map(|seed| draw_case(seed, Kind::Null, CaseSize { frames: 4, shots: 6_000 }))
        .find(|case| {
            let setting = &case.measured.setting;
            setting.layout == crate::sensor::Layout::RoofAndGrille && setting.intensity.is_of_surface()
        })
        .unwrap();
    let mut rng = data::stream(3, "tests", 0, 0);
    for cause in CAUSES.into_iter().chain(OFF_CATALOGUE) {
        let effect = draw_effect(cause, &case.measured.mounts, 0.1, &mut rng);
        let side = with(&case, effect.clone());
        let changed = (0..4).any(|i| {
            let [a, b] = [&side, &case.measured].map(|s| Frame::new(s, i).scan());
            a.points != b.points || a.labels != b.labels || a.lights != b.lights
        });
        assert!(changed, "{effect:?} changes nothing");
    }
}
