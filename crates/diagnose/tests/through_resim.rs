//! Effects that `resim` applies to a simulated data set are found, and the extension that is written corrects the
//! simulation.

use data::Dataset;
use lidarshift_diagnose::{
    Cause, Channel, Covariate, Diagnosis, Options, Outcome, Quantity, Rig, Status, diagnose, extended_toml,
};
use sensor::EffectList;
use simulate::race::{RaceConfig, make_race_datasets};
use simulate::resim::Resim;
use std::path::Path;

/// A small race without any effect.
fn race(folder: &Path) -> Dataset {
    let text = "name = \"r\"\nseed = 3\nrig = \"rig.toml\"\nframes = 30\nresolution = 0.3\nlabel_points = 1\nrace = { runs = 1, frames = 1500 }\n\
                [[dataset]]\nname = \"sim\"\neffects = \"none.toml\"\n";
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs");
    fs_err::copy(configs.join("sensors/av21.toml"), folder.join("rig.toml")).unwrap();
    fs_err::write(folder.join("none.toml"), "").unwrap();
    fs_err::write(folder.join("r.toml"), text).unwrap();
    let (config, files) = RaceConfig::find(&folder.join("r.toml").display().to_string()).unwrap();
    make_race_datasets(&config, &files, folder, &[], &|_, _, _| ()).unwrap();
    Dataset::open(&folder.join("sim")).unwrap()
}

fn with_effects(dataset: &Dataset, effects: &str, out: &Path, seed: u64) -> Dataset {
    let effects = EffectList::parse(effects, Path::new("effects.toml")).unwrap();
    Resim { dataset, effects: &effects, rig: None, seed }.make(out, &|_, _| ()).unwrap();
    Dataset::open(out).unwrap()
}

fn diagnosed(measured: &Dataset, simulated: &Dataset, folder: &Path) -> Outcome {
    let rig = Rig::read(&folder.join("rig.toml")).unwrap();
    diagnose(measured, simulated, &rig, &Options::default(), &|_, _, _| ()).unwrap()
}

fn named(d: &Diagnosis) -> Vec<&str> {
    let mut names: Vec<&str> = d.findings.iter().map(|f| f.cause.map_or("-", |c| c.name())).collect();
    names.sort_unstable();
    names
}

/// The two causes that the paper assumes for its gap: 2 cm of noise and a fifth of the returns lost.
#[test]
fn the_two_causes_of_the_paper_are_found_and_corrected() {
    let folder = tempfile::tempdir().unwrap();
    let sim = race(folder.path());
    let causes =
        "[[effect]]\nkind = \"range_noise\"\nstd_m = 0.02\n[[effect]]\nkind = \"random_dropout\"\nshare = 0.2\n";
    let measured = with_effects(&sim, causes, &folder.path().join("measured"), 11);
    let outcome = diagnosed(&measured, &sim, folder.path());
    let d = &outcome.diagnosis;
    assert_eq!(named(d), ["random_dropout", "range_noise"], "{:?}", d.findings);
    for (cause, quantity, truth) in
        [(Cause::RangeNoise, Quantity::StdM, 0.02), (Cause::RandomDropout, Quantity::Share, 0.2)]
    {
        let p = d.findings.iter().find(|f| f.cause == Some(cause)).unwrap().parameter(quantity).unwrap();
        assert!(p.ci95[0] <= truth && truth <= p.ci95[1], "{cause}: {p:?}");
        assert!((p.estimate / truth - 1.0).abs() < 0.05, "{cause}: {p:?}");
    }
    assert!(d.gain.closed.unwrap() > 0.9, "{:?}", d.gain);
    // With the extended simulation there are no findings.
    let extended = extended_toml(d);
    let again = with_effects(&sim, &extended, &folder.path().join("extended"), 12);
    let outcome = diagnosed(&measured, &again, folder.path());
    assert!(outcome.diagnosis.findings.is_empty(), "{:?}", outcome.diagnosis.findings);
}

/// An unexplained finding is extended as a lookup table, which corrects the simulation.
#[test]
fn an_unexplained_finding_is_corrected_by_a_table() {
    let folder = tempfile::tempdir().unwrap();
    let sim = race(folder.path());
    let stripes = "[[effect]]\nkind = \"empirical\"\ncovariate = \"azimuth_deg\"\n\
                   at = [-61.0, -45.0, -44.0, -20.0, -19.0, 5.0, 6.0, 30.0, 31.0, 61.0]\n\
                   loss = [0.0, 0.0, 0.4, 0.4, 0.0, 0.0, 0.4, 0.4, 0.0, 0.0]\n";
    let measured = with_effects(&sim, stripes, &folder.path().join("measured"), 11);
    let outcome = diagnosed(&measured, &sim, folder.path());
    let d = &outcome.diagnosis;
    // The mean of the stripes may be named a random loss; the remaining dependence on the azimuth is unexplained.
    let unnamed = d.findings.iter().find(|f| f.status == Status::Unexplained).unwrap();
    assert_eq!((unnamed.channel, unnamed.covariate), (Channel::Hits, Covariate::Azimuth), "{:?}", d.findings);
    assert!(unnamed.gain.ci95[0] > 0.0 && d.findings.iter().all(|f| f.channel == Channel::Hits), "{:?}", d.findings);
    let found: f64 = d.findings.iter().map(|f| f.gain.nats_per_ray).sum();
    let extended = extended_toml(d);
    let again = with_effects(&sim, &extended, &folder.path().join("extended"), 12);
    let outcome = diagnosed(&measured, &again, folder.path());
    let left: f64 = outcome.diagnosis.findings.iter().map(|f| f.gain.nats_per_ray).sum();
    assert!(left < 0.1 * found, "{left} of {found}");
}
