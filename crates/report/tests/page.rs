//! Tests of the complete report of a study: the self-contained page and its files.

use data::{Cloud, Detection, Frame, LabelBox, LabelFrame, Object, stream};
use diagnose::{Diagnosis, Discrepancy, Switch, Verdict, View, ViewState};
use eval::analysis::{AnalysisOptions, BoxPoints, analyse};
use eval::distance::{DistanceOptions, Regions, compare};
use eval::features::{CkaTable, Embedded, Embedding, TSNE_SCHEMA, TsneOptions};
use eval::matrix::{
    MatrixOptions, MatrixPlan, Place, PlannedNetwork, RunId, RunScores, ScoredFrames, build, paired_differences,
};
use eval::targets::{TargetOptions, targets};
use eval::{BootstrapOptions, EvalFrame};
use geometry::Box3;
use lidarshift_report::{DiagnosisReport, FrechetRow, Layer, LayerContent, Link, Scene, StudyReport, TrainingRun};
use rand::RngExt;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A road with a wall and a car, with range noise of `noise`.
fn frame(id: usize, noise: f32) -> Frame {
    let mut rng = stream(id as u64, "report test scene", 0, 0);
    let (x, y, yaw) = (rng.random_range(-90.0..90.0), rng.random_range(-8.0..8.0), rng.random_range(-0.2..0.2));
    let car = Box3::from_array([x, y, -0.4, 4.88, 1.9, 1.18, yaw]);
    let mut cloud = Cloud::new(3);
    let mut jitter = stream(id as u64, "report test noise", 0, (noise * 1000.0) as u64);
    let mut push = |p: [f64; 3], cloud: &mut Cloud| {
        let off: f32 = jitter.random_range(-1.0..1.0) * noise;
        cloud.values.extend(p.map(|v| v as f32 + off));
    };
    for k in 0..1600 {
        let (range, azimuth) = (4.0 + f64::from(k % 40) * 2.3, f64::from(k) * 0.157);
        push([range * azimuth.cos(), range * azimuth.sin(), -1.0], &mut cloud);
    }
    for k in 0..500 {
        push([f64::from(k) * 0.4 - 100.0, 14.0, f64::from(k % 6) * 0.4 - 1.0], &mut cloud);
    }
    let n = (60_000.0 / (x * x + y * y + 100.0)) as usize;
    for _ in 0..n {
        let (u, v, w) = (rng.random_range(-0.5..0.5), rng.random_range(-0.5..0.5), rng.random_range(-0.5..0.5));
        push(car.from_local([u * 4.88, v * 1.9 * (1.0 - f64::abs(u)), w * 1.18]), &mut cloud);
    }
    let object = Object { class: "Car".into(), bbox: car, truncation: None, occlusion: None, image_box: None };
    Frame { id: format!("{id:06}"), cloud, objects: vec![object] }
}

/// Detections of a network with this box noise.
fn found(frame: &Frame, seed: u64, noise: f64) -> Vec<Detection> {
    let mut rng = stream(seed, "report test run", 0, frame.id.parse().unwrap());
    let mut out = Vec::new();
    let mut b = frame.objects[0].bbox;
    let far = 1.0 + b.center[0].abs() / 60.0;
    if rng.random_range(0.0..1.0) < 0.97 - 0.1 * noise * far {
        for v in &mut b.center {
            *v += rng.random_range(-noise..=noise) * 0.4 * far;
        }
        b.yaw_rad += rng.random_range(-0.05..0.05);
        out.push(Detection { class: "Car".into(), bbox: b, score: rng.random_range(0.3..1.0) });
    }
    if rng.random_range(0.0..1.0) < 0.2 {
        let bbox = Box3::from_array([rng.random_range(-90.0..90.0), 3.0, -0.4, 4.8, 1.9, 1.2, 0.0]);
        out.push(Detection { class: "Car".into(), bbox, score: rng.random_range(0.1..0.5) });
    }
    out
}

fn eval_frames(frames: &[Frame], seed: u64, noise: f64) -> Vec<EvalFrame> {
    let line = |class: &str, b: &Box3, score| LabelBox::from_box(class, b, score);
    frames
        .iter()
        .map(|f| EvalFrame {
            id: f.id.clone(),
            labels: f.objects.iter().map(|o| line(&o.class, &o.bbox, None)).collect(),
            detections: found(f, seed, noise).iter().map(|d| line(&d.class, &d.bbox, Some(d.score))).collect(),
        })
        .collect()
}

fn report() -> StudyReport {
    let bootstrap = BootstrapOptions { replicates: 40, ..BootstrapOptions::default() };
    let frames: Vec<Frame> = (0..60).map(|i| frame(i, 0.0)).collect();
    let places = [("real", "Real"), ("sim", "Sim"), ("sim-noise", "Sim Noise")];
    let place =
        |(name, title): (&str, &str)| Place { name: name.into(), title: title.into(), paper: Some(title.into()) };
    let network = |title: &str, n: u64| PlannedNetwork {
        network: Place { name: title.to_lowercase(), title: title.into(), paper: Some(title.into()) },
        train_sets: places.map(place).to_vec(),
        seeds: (1..=n).collect(),
    };
    let plan = MatrixPlan {
        networks: vec![network("PointPillars", 3), network("PointRCNN", 2)],
        test_sets: places.map(place).to_vec(),
        ..MatrixPlan::default()
    };
    let options = MatrixOptions { bootstrap: bootstrap.clone(), ..MatrixOptions::default() };
    let mut results = BTreeMap::new();
    for planned in &plan.networks {
        for (i, train) in planned.train_sets.iter().enumerate() {
            for (j, test) in plan.test_sets.iter().enumerate() {
                for &seed in &planned.seeds {
                    let noise = 0.3 + 0.7 * i.abs_diff(j) as f64 + 0.2 * f64::from(u8::from(j == 0));
                    let run = RunId { network: planned.network.name.clone(), train_set: train.name.clone(), seed };
                    let key = (run, test.name.clone());
                    if planned.network.name == "pointrcnn" && i == 2 {
                        if seed == 1 {
                            results.insert(key, Err("checkpoint/last.safetensors is of another configuration".into()));
                        }
                        continue;
                    }
                    let of_run = eval_frames(&frames, seed * 10 + i as u64 * 100 + j as u64, noise);
                    results.insert(key, Ok(RunScores::new(&of_run, None, LabelFrame::Lidar, &options)));
                }
            }
        }
    }
    let ids: Vec<String> = frames.iter().map(|f| f.id.clone()).collect();
    let scores = |noise: f64| RunScores::new(&eval_frames(&frames, 7, noise), None, LabelFrame::Lidar, &options);
    let (on_real, on_sim) = (scores(0.9), scores(0.3));
    let paired = paired_differences(
        ["pointpillars", "real", "sim"],
        [&on_real, &on_sim].map(|scores| ScoredFrames::new(scores, &ids)),
        None,
        &options,
    );
    let analysis = |name: &str, noise: f64| {
        let of_run = eval_frames(&frames, 1, noise);
        let boxes = |lines: &[LabelBox]| lines.iter().map(LabelBox::lidar_box).collect::<Vec<_>>();
        let points: Vec<BoxPoints> = frames
            .iter()
            .zip(&of_run)
            .map(|(f, e)| BoxPoints::count(&f.cloud, &boxes(&e.labels), &boxes(&e.detections)))
            .collect();
        let options = AnalysisOptions { overlap: 0.5, ..AnalysisOptions::default() };
        (name.to_string(), analyse(&of_run, Some(&points), &options))
    };
    let embedded = |k: usize| {
        let mut rng = stream(k as u64, "report test tsne", 0, 0);
        let (group, seed) = (k / 90, k / 30 % 3);
        let at = [group as f64 * 9.0 + seed as f64 * 3.0, f64::from((k % 7) as u32)];
        Embedded {
            train_set: places[group].1.into(),
            seed: seed as u64 + 1,
            frame: format!("{:06}", k % 30),
            at: at.map(|v| v + rng.random_range(-1.0..1.0)),
        }
    };
    let ids: Vec<String> = (0..6).map(|i| i.to_string()).collect();
    let distance_options = DistanceOptions {
        emd_points: 32,
        sinkhorn_points: 32,
        sinkhorn_iterations: 10,
        directions: 8,
        bootstrap,
        ..DistanceOptions::default()
    };
    let regions = Regions {
        names: ["ground", "target", "behind the wall", "other"].map(String::from).to_vec(),
        of: Box::new(|frame, points| {
            let of = |p: &[f32; 3]| match *p {
                [_, _, z] if z < -0.8 => 0,
                p if frame.objects[0].bbox.to_local(p.map(f64::from))[0].abs() < 2.5 => 1,
                [_, y, _] if y > 13.5 => 2,
                _ => 3,
            };
            points.iter().map(of).collect()
        }),
    };
    let of_pair = |id: &str| {
        let id = id.parse().unwrap();
        let mut noisy = frame(id, 0.05);
        noisy.cloud.values.extend([80.0, 40.0, 3.0, 81.0, 40.0, 3.5]);
        Ok([noisy, frame(id, 0.0)])
    };
    let distances = compare(["Real", "Sim"], &ids, of_pair, Some(&regions), &distance_options).unwrap();
    let of_set = |title: &str, noise: f32| {
        let ids: Vec<String> = (0..60).map(|i| i.to_string()).collect();
        targets(title, &ids, |id| Ok(frame(id.parse().unwrap(), noise)), &TargetOptions::default()).unwrap()
    };
    let curve = |k: f64| TrainingRun {
        name: format!("PointPillars, Sim, seed {k}"),
        loss: (1..40).map(|i| [f64::from(i) * 50.0, (2.0 + k * 0.2) / f64::from(i).sqrt()]).collect(),
        validation_ap: (1..8).map(|i| [f64::from(i) * 250.0, 80.0 - 60.0 / f64::from(i)]).collect(),
    };
    let (shown, noisy) = (frame(3, 0.0), frame(3, 0.05));
    let layer = |name: &str, color: &str, content| Layer { name: name.into(), color: color.into(), content };
    let scene = Scene {
        name: "frame </script> 000003".into(),
        focus_m: Some(shown.objects[0].bbox.center),
        layers: vec![
            layer("measured", "#0072b2", LayerContent::Cloud(noisy.cloud)),
            layer("simulated", "#d55e00", LayerContent::Cloud(shown.cloud.clone())),
            layer("labels", "#009e73", LayerContent::Boxes(vec![shown.objects[0].bbox])),
            layer("detections", "#cc79a7", LayerContent::Boxes(found(&shown, 1, 0.5).iter().map(|d| d.bbox).collect())),
        ],
        on: None,
    };
    let layers = ["vfe", "block 1", "block 2", "head"].map(String::from).to_vec();
    StudyReport {
        title: "A study of <made up> data".into(),
        about: vec!["Everything here is made up for a test of the page; no network was trained.".into()],
        links: vec![Link { text: "The <diagnosis>".into(), href: "../found/report.html?\"".into() }],
        command: "cargo test -p lidarshift-report".into(),
        facts: vec![("seeds".into(), "1, 2, 3".into()), ("machine".into(), "two cores".into())],
        warnings: vec![],
        matrix: Some(build(&plan, &results, &options)),
        paired,
        analyses: vec![analysis("PointPillars, Sim to Sim", 0.4), analysis("PointPillars, Sim to Real", 1.2)],
        embeddings: vec![Embedding {
            schema: TSNE_SCHEMA.into(),
            network: "PointPillars".into(),
            layer: "backbone, mean over the map".into(),
            test_set: "Real".into(),
            options: TsneOptions::default(),
            kl_divergence: 0.81,
            points: (0..270).map(embedded).collect(),
        }],
        cka: vec![(
            "PointPillars, Sim against Real".into(),
            CkaTable {
                layers_a: layers.clone(),
                layers_b: layers,
                values: (0..4)
                    .map(|i| (0..4).map(|j| Some(1.0 - 0.2 * f64::from(i32::abs(i - j)))).collect())
                    .collect(),
            },
        )],
        frechet: vec![FrechetRow {
            network: "PointPillars".into(),
            a: "Real".into(),
            b: "Sim".into(),
            distance: 12.25,
            floor: Some(0.75),
        }],
        distances: vec![distances],
        targets: vec![of_set("Real", 0.06), of_set("Sim", 0.0)],
        training: vec![curve(1.0), curve(2.0)],
        scenes: vec![scene],
    }
}

fn written() -> (PathBuf, String) {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("page");
    let files = report().write(&folder).unwrap();
    let html = std::fs::read_to_string(&files.page).unwrap();
    assert_eq!(files.page_bytes, html.len());
    for file in &files.others {
        assert!(std::fs::metadata(file).unwrap().len() > 40, "{} is empty", file.display());
    }
    let count = |ending: &str| files.others.iter().filter(|f| f.extension().is_some_and(|e| e == ending)).count();
    assert!(count("svg") >= 15 && count("svg") == count("png") && count("csv") >= 15, "{:?}", files.others);
    (files.page, html)
}

/// The DOM of the page in a browser without network, if a browser is installed.
fn in_browser(page: &Path, more: &[&str]) -> Option<String> {
    let browser = ["chromium", "chromium-browser", "google-chrome"]
        .into_iter()
        .find(|name| Command::new(name).arg("--version").output().is_ok_and(|out| out.status.success()));
    let Some(browser) = browser else {
        eprintln!("skipped: there is no Chromium");
        return None;
    };
    let profile = tempfile::tempdir().unwrap();
    let out = Command::new(browser)
        .args([
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--enable-unsafe-swiftshader",
            "--virtual-time-budget=4000",
        ])
        .args(["--proxy-server=127.0.0.1:9", "--window-size=1200,900"])
        .arg(format!("--user-data-dir={}", profile.path().display()))
        .args(more)
        .arg(format!("file://{}", page.display()))
        .output()
        .unwrap();
    Some(String::from_utf8_lossy(&out.stdout).into_owned())
}

/// A page of a diagnosis with one frame in 3D, whose second finding is chosen by a script and switched off.
#[test]
fn findings_are_switched_in_a_browser() {
    let state = |value: f32| ViewState { values: vec![Some(value), None], lost_m: vec![[3.0; 3]] };
    let [off, on] = [0.19, 0.0].map(state);
    let of_ranges = Switch { finding: None, discrepancy: Discrepancy::Range, off, on };
    let of_scatter = Switch { discrepancy: Discrepancy::Scatter, ..of_ranges.clone() };
    let switches = vec![of_ranges, of_scatter];
    let view = View { frame: "000007".into(), points_m: vec![[1.0; 3], [2.0; 3]], switches };
    let diagnosis = Diagnosis {
        schema: diagnose::SCHEMA.into(),
        build: String::new(),
        verdict: Verdict::NothingFound,
        frames: Default::default(),
        findings: vec![],
        minimum_detectable: Default::default(),
        gain: Default::default(),
        detectors: vec![],
        not_identifiable: vec![],
        considered: vec![],
        notes: vec![],
    };
    let report = DiagnosisReport {
        diagnosis: &diagnosis,
        view: Some(&view),
        links: vec![],
        title: "a against b".into(),
        command: String::new(),
    };
    let change = "<script>for (const [at, key, value] of [['select', 'value', 1], ['.switch input', 'checked', false]]) {\
                  const found = document.querySelector('.viewer ' + at); found[key] = value;\
                  found.dispatchEvent(new Event('change')); }</script></body>";
    let html = report.html().unwrap();
    for (number, (html, end, checkboxes)) in
        [(html.clone(), "0.2 m farther than simulated", 3), (html.replace("</body>", change), "scatter 0.2 m less", 2)]
            .into_iter()
            .enumerate()
    {
        let page = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("diagnosis-{number}.html"));
        std::fs::write(&page, html).unwrap();
        let Some(dom) = in_browser(&page, &["--dump-dom"]) else { return };
        assert_eq!(dom.matches("All findings</option>").count(), 2, "the list has both");
        assert_eq!(dom.matches("<input type=\"checkbox\"").count(), checkboxes, "the switch and the layers");
        assert!(dom.contains(end) && dom.contains("linear-gradient(to right, rgb("), "{end}");
        assert!(!dom.contains("class=\"viewer no-webgl\""), "WebGL by SwiftShader");
    }
}

#[test]
fn the_page_is_whole_and_needs_nothing() {
    let (page, html) = written();
    // Nothing is loaded: the only addresses are namespaces and embedded data, apart from the code of the 3D view.
    let begin = html.rfind("<script>").unwrap();
    let text = &html[..begin];
    for part in ["src=", "<link", "@import", "url("] {
        assert!(!text.contains(part), "{part}");
    }
    let addresses = text
        .match_indices("://")
        .filter(|(at, _)| !text[..*at].ends_with("http") || !text[*at..].starts_with("://www.w3.org/"));
    assert_eq!(addresses.count(), 0);
    // Text is escaped.
    assert!(html.contains("A study of &#60;made up&#62; data") || html.contains("A study of &lt;made up&gt; data"));
    assert_eq!(text.matches("</script>").count(), 1, "the scene's name must not end its element");
    for part in ["NaN", "inf%", "{{", "{%"] {
        assert!(!text.contains(part), "{part}");
    }
    // Content that must not be missing.
    for part in [
        "<a href=\"../found/report.html?&#34;\">The &#60;diagnosis&#62;</a>",
        "is of another configuration",
        "seed 2 is missing",
        "0 of 2",
        "the paper",
        "Figure 1",
        "Table 1",
        "prefers-color-scheme: dark",
        "@media print",
        "behind the wall",
        "Kullback-Leibler divergence 0.810",
    ] {
        assert!(html.contains(part), "{part}");
    }
    assert!(html.len() < 25_000_000, "{} bytes", html.len());
    let Some(dom) = in_browser(&page, &["--dump-dom"]) else { return };
    assert!(dom.contains("frame &lt;/script&gt; 000003</option>"), "the view lists its frames");
    assert_eq!(dom.matches("<input type=\"checkbox\"").count(), 4, "a switch for each layer");
    assert!(!dom.contains("class=\"viewer no-webgl\""), "WebGL by SwiftShader");
}
