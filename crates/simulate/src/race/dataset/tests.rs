use super::*;
use data::doctor::doctor;

/// A small race in its own folder: few frames, few shots, all kinds of data sets.
fn small(folder: &Path, more: &str) -> (RaceConfig, ConfigFiles) {
    let text = format!(
        "name = \"r\"\nseed = 3\nrig = \"rig.toml\"\nframes = 18\nresolution = 0.25\nlabel_points = 1\nrace = {{ runs = 2, frames = 400 }}\n{more}\n\
         [[dataset]]\nname = \"measured\"\neffects = \"measured.toml\"\nhidden = true\nauto_label = {{}}\n\
         [[dataset]]\nname = \"sim\"\neffects = \"sim.toml\"\n\
         [[dataset]]\nname = \"sim_noise\"\nfrom = \"sim\"\neffects = \"sim_noise.toml\"\n\
         [[dataset]]\nname = \"sim_matched\"\nfrom = \"sim\"\nmatched_to = \"measured\"\n"
    );
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs");
    for name in ["measured", "sim", "sim_noise"] {
        std::fs::copy(configs.join(format!("simulate/{name}.toml")), folder.join(format!("{name}.toml"))).unwrap();
    }
    std::fs::copy(configs.join("sensors/av21.toml"), folder.join("rig.toml")).unwrap();
    let path = folder.join("r.toml");
    std::fs::write(&path, text).unwrap();
    RaceConfig::find(&path.display().to_string()).unwrap()
}

fn make(config: &(RaceConfig, ConfigFiles), out: &Path, threads: usize) -> Result<Vec<RaceManifest>, SimulateError> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| make_race_datasets(&config.0, &config.1, out, &[], &|_, _, _| ()))
}

/// All files below a folder with their bytes, by path.
fn files_below(root: &Path) -> BTreeMap<String, Vec<u8>> {
    let (mut open, mut found) = (vec![root.to_owned()], BTreeMap::new());
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                found.insert(path.strip_prefix(root).unwrap().display().to_string(), std::fs::read(path).unwrap());
            }
        }
    }
    found
}

#[test]
fn the_same_bytes_for_any_number_of_threads_and_after_a_stop() {
    let folder = tempfile::tempdir().unwrap();
    let config = small(folder.path(), "attributes = true");
    let [one, two] = ["one", "two"].map(|name| folder.path().join(name));
    let manifests = make(&config, &one, 1).unwrap();
    assert_eq!(make(&config, &two, 2).unwrap(), manifests);
    let all = files_below(&one);
    assert!(all == files_below(&two));
    let some = all.keys().find(|k| k.starts_with("sim/velodyne")).unwrap().clone();
    for lost in [some.as_str(), "sim/dataset.toml", "measured/ImageSets/val.txt", "sim_noise/effects.toml"] {
        std::fs::remove_file(two.join(lost)).unwrap();
    }
    assert_eq!(make(&config, &two, 2).unwrap(), manifests);
    assert!(all == files_below(&two), "a run again changes nothing");
    assert!(manifests.iter().all(|m| m.complete && m.splits["train"].frames == 12 && m.splits["test"].frames == 3));

    // Hidden effects of `measured` are in none of its files.
    assert!(!all.contains_key("measured/effects.toml") && all.contains_key("sim/effects.toml"));
    for (name, bytes) in all.iter().filter(|(name, _)| name.starts_with("measured/") && !name.contains("/velodyne/")) {
        let text = String::from_utf8_lossy(bytes);
        assert!(!text.contains("heavy_tails") && !text.contains("signal_dropout"), "{name}");
    }
}

#[test]
fn the_data_sets_show_the_same_race() {
    let folder = tempfile::tempdir().unwrap();
    let config = small(folder.path(), "layout = \"s2r_dad\"");
    let out = folder.path().join("out");
    let manifests = make(&config, &out, 2).unwrap();
    let open = |name: &str| Dataset::open(&out.join(name)).unwrap();
    let (measured, sim, noise, matched) = (open("measured"), open("sim"), open("sim_noise"), open("sim_matched"));
    let ids = sim.all_ids().unwrap();
    let mut offsets = Vec::new();
    for id in &ids {
        let [m, s, n, d] = [&measured, &sim, &noise, &matched].map(|set| set.load(id).unwrap());
        assert_eq!(m.objects.len(), s.objects.len(), "the same cars");
        for (a, b) in m.objects.iter().zip(&s.objects) {
            let [x, y, _] = b.bbox.to_local(a.bbox.center);
            assert!(x.abs() < 2.0 && y.abs() < 1.0, "{x} {y}");
            offsets.push(x.abs());
        }
        assert_eq!((s.objects.clone(), n.cloud.len()), (n.objects.clone(), s.cloud.len()));
        // Noise moves points by centimetres along their rays, and has no other effect.
        let moved: Vec<f64> = (0..s.cloud.len())
            .map(|i| {
                let (a, b) = (s.cloud.xyz(i), n.cloud.xyz(i));
                f64::from((0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f32>().sqrt())
            })
            .collect();
        let rms = (moved.iter().map(|v| v * v).sum::<f64>() / moved.len() as f64).sqrt();
        assert!((rms - 0.02).abs() < 2e-3, "{rms}");
        assert!(d.cloud.len() < s.cloud.len());
    }
    assert!(offsets.iter().any(|x| *x > 0.005), "labels of `measured` are not exact");
    let points = |i: usize| manifests[i].splits["train"].points as f64;
    assert!((points(3) / points(0).min(points(1)) - 1.0).abs() < 0.1, "{} {} {}", points(0), points(1), points(3));
    let errors = &manifests[0].label_errors;
    assert!(errors.iter().map(|e| e.labels).sum::<usize>() > 10 && errors[0].rms_m[0] < 0.6, "{errors:?}");
}

#[test]
fn doctor_finds_nothing_wrong() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = small(folder.path(), "");
    // At a quarter of the resolution distant cars have no points, which the doctor would report.
    config.0.resolution = 1.0;
    let out = folder.path().join("out");
    make(&config, &out, 2).unwrap();
    for name in ["measured", "sim"] {
        let report = doctor(&Dataset::open(&out.join(name)).unwrap(), None).unwrap();
        assert!(report.sound, "{name}: {report}");
    }
}

#[test]
fn another_folder_is_not_touched_and_bad_files_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let (config, files) = small(folder.path(), "");
    let out = folder.path().join("out");
    let make = |config: &RaceConfig, only: &[&str]| {
        let only: Vec<String> = only.iter().map(|s| s.to_string()).collect();
        make_race_datasets(config, &files, &out, &only, &|_, _, _| ()).map_err(|e| e.to_string())
    };
    make(&config, &["sim"]).unwrap();
    assert!(!out.join("measured").exists());
    let other = RaceConfig { seed: 4, ..config.clone() };
    assert!(make(&other, &["sim"]).unwrap_err().contains("another configuration"));
    assert!(make(&config, &["simm"]).unwrap_err().contains("there is no \"simm\"; there are: measured, sim"));
    std::fs::create_dir_all(out.join("measured")).unwrap();
    std::fs::write(out.join("measured/thesis.txt"), "").unwrap();
    assert!(make(&config, &["measured"]).unwrap_err().contains("not empty"));
    assert!(make(&config, &["sim_matched"]).unwrap_err().contains("measured"), "the set to match is not there");

    std::fs::write(folder.path().join("sim.toml"), "[[effect]]\nkind = \"range_noise\"\nstd_m = -1\n").unwrap();
    assert!(make(&config, &["sim"]).unwrap_err().contains("sim.toml:3: effect[0].std_m"));
    std::fs::write(folder.path().join("rig.toml"), "[[sensor]]\nname = \"a\"\n").unwrap();
    assert!(make(&config, &["sim"]).unwrap_err().contains("has no pattern"));
}

#[test]
fn a_disk_that_is_too_small_is_refused_before_anything_is_made() {
    let folder = tempfile::tempdir().unwrap();
    let needs = |bytes: u64| {
        check_free(folder.path().join("not/there").as_path(), bytes, "2 data sets").map_err(|e| e.to_string())
    };
    needs(1 << 20).unwrap();
    let error = needs(1 << 60).unwrap_err();
    assert!(error.contains("GB free, but up to") && error.contains("lower `frames`"), "{error}");
}
