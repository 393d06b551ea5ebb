//! Two drives that are not the same: what the sensor does is found, what cannot be identified is listed, and nothing
//! is found where only the drives differ.

use data::Dataset;
use lidarshift_diagnose::{
    Cause, Diagnosis, OnClouds, Options, Outcome, Quantity, Rig, Status, Verdict, diagnose_unpaired,
};
use sensor::EffectList;
use sensor::directions::split_with_places;
use simulate::race::{RaceConfig, make_race_datasets};
use simulate::resim::Resim;
use std::path::Path;

/// A small race of a seed, without any effect.
fn race(folder: &Path, name: &str, seed: u64) -> Dataset {
    let text = format!(
        "name = \"{name}\"\nseed = {seed}\nrig = \"rig.toml\"\nframes = 30\nresolution = 0.3\nlabel_points = 1\nrace = {{ runs = 1, frames = 1500 }}\n\
         [[dataset]]\nname = \"{name}\"\neffects = \"none.toml\"\n"
    );
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs");
    fs_err::copy(configs.join("sensors/av21.toml"), folder.join("rig.toml")).unwrap();
    fs_err::write(folder.join("none.toml"), "").unwrap();
    let path = folder.join(format!("{name}.toml"));
    fs_err::write(&path, text).unwrap();
    let (config, files) = RaceConfig::find(&path.display().to_string()).unwrap();
    make_race_datasets(&config, &files, folder, &[], &|_, _, _| ()).unwrap();
    Dataset::open(&folder.join(name)).unwrap()
}

fn with_effects(dataset: &Dataset, effects: &str, out: &Path) -> Dataset {
    let effects = EffectList::parse(effects, Path::new("effects.toml")).unwrap();
    Resim { dataset, effects: &effects, rig: None, seed: 11 }.make(out, &|_, _| ()).unwrap();
    Dataset::open(out).unwrap()
}

fn diagnosed(measured: &Dataset, simulated: &Dataset, folder: &Path) -> Outcome {
    let rig = Rig::read(&folder.join("rig.toml")).unwrap();
    let remake = OnClouds { simulated, rig: &rig };
    diagnose_unpaired(measured, simulated, &rig, &Options::default(), &remake, &|_, _, _| ()).unwrap()
}

fn named(d: &Diagnosis) -> Vec<&str> {
    let mut names: Vec<&str> = d.findings.iter().map(|f| f.cause.map_or("-", |c| c.name())).collect();
    names.sort_unstable();
    names
}

#[test]
fn effects_of_the_sensor_are_found_on_another_drive_and_drives_are_no_effect() {
    let folder = tempfile::tempdir().unwrap();
    let (real, sim) = (race(folder.path(), "real", 3), race(folder.path(), "sim", 8));
    let nothing = diagnosed(&real, &sim, folder.path()).diagnosis;
    assert_eq!(nothing.verdict, Verdict::NothingFound, "{:?}", nothing.findings);
    // What cannot be identified has the reason, and is not said to have been looked for.
    let bias = nothing.not_identifiable.iter().find(|n| n.cause == Cause::RangeBias).unwrap();
    assert!(!bias.why.is_empty() && !bias.tell_by.is_empty());
    assert!(nothing.minimum_detectable.keys().all(|cause| nothing.not_identifiable.iter().all(|n| n.cause != *cause)));

    let effects = "[[effect]]\nkind = \"range_noise\"\nstd_m = 0.03\n\
                   [[effect]]\nkind = \"random_dropout\"\nshare = 0.2\n";
    let measured = with_effects(&real, effects, &folder.path().join("measured"));
    let outcome = diagnosed(&measured, &sim, folder.path());
    let d = &outcome.diagnosis;
    assert_eq!(named(d), ["random_dropout", "range_noise"], "{:?} {:?}", d.findings, d.notes);
    for (cause, quantity, truth) in
        [(Cause::RangeNoise, Quantity::StdM, 0.03), (Cause::RandomDropout, Quantity::Share, 0.2)]
    {
        let p = d.findings.iter().find(|f| f.cause == Some(cause)).unwrap().parameter(quantity).unwrap();
        assert!((p.estimate / truth - 1.0).abs() < 0.1, "{cause}: {p:?}");
    }
    assert!(d.gain.closed.unwrap() > 0.9 && d.gain.not_applied.is_empty(), "{:?}", d.gain);
    // The file of the diagnosis, put on the simulation, leaves nothing to be found.
    let again = with_effects(&sim, &outcome.extended, &folder.path().join("extended"));
    let left = diagnosed(&measured, &again, folder.path()).diagnosis;
    assert!(left.findings.is_empty(), "{:?}", left.findings);
}

/// Rough ground is of the street: noise of the ground alone has no name.
#[test]
fn noise_of_one_kind_of_surface_is_not_the_sensors() {
    let folder = tempfile::tempdir().unwrap();
    let (real, sim) = (race(folder.path(), "real", 3), race(folder.path(), "sim", 8));
    let rough = folder.path().join("rough");
    with_effects(&real, "", &rough);
    let rough = Dataset::open(&rough).unwrap();
    let rig = Rig::read(&folder.path().join("rig.toml")).unwrap();
    for id in rough.all_ids().unwrap() {
        let mut cloud = rough.load_cloud(&id).unwrap();
        let channels = cloud.channels;
        let (_, places) = split_with_places(&cloud, &rig);
        for (sensor, places) in rig.sensors.iter().zip(places) {
            let origin = sensor.position.map(|v| v as f32);
            for place in places {
                let point = &mut cloud.values[place as usize * channels..][..3];
                let below = origin[2] - point[2];
                // Low points are of the ground: gravel of 2 cm, met where the ray comes down to it.
                if point[2] < 0.1 && below > 0.1 {
                    let up = 0.02 * (((place * 7919) % 1000) as f32 / 1000.0 - 0.5);
                    let nearer = 1.0 - up / below;
                    point.iter_mut().zip(origin).for_each(|(v, from)| *v = from + (*v - from) * nearer);
                }
            }
        }
        let bytes: Vec<u8> = cloud.values.iter().flat_map(|v| v.to_le_bytes()).collect();
        fs_err::write(rough.cloud_path(&id), bytes).unwrap();
    }
    let d = diagnosed(&rough, &sim, folder.path()).diagnosis;
    assert!(d.findings.iter().all(|f| f.status != Status::Named), "{:?}", d.findings);
}

#[test]
fn too_few_frames_of_a_side_are_a_verdict() {
    let folder = tempfile::tempdir().unwrap();
    let (real, sim) = (race(folder.path(), "real", 3), race(folder.path(), "sim", 8));
    let rig = Rig::read(&folder.path().join("rig.toml")).unwrap();
    let leave_out = real.all_ids().unwrap()[3..].iter().cloned().collect();
    let options = Options { leave_out, ..Options::default() };
    let remake = OnClouds { simulated: &sim, rig: &rig };
    let d = diagnose_unpaired(&real, &sim, &rig, &options, &remake, &|_, _, _| ()).unwrap().diagnosis;
    assert_eq!(d.verdict, Verdict::TooFewFrames);
    assert!(d.notes.iter().any(|n| n.starts_with("3 measured and 30 simulated frames")), "{:?}", d.notes);
}
