//! Detectors that were trained elsewhere, through the program: studies of detections and checkpoints, and bad input.

mod forms;
#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use data::{Dataset, Detection, Frame, LabelBox, to_kitti_text};
use program::{data_set, must, output_text, result_pkl, run};
use std::fs;
use std::path::Path;

/// Two data sets with the same seven frames; detections as KITTI text and as `result.pkl`.
const STUDY: &str = r#"
name = "frozen"
about = ["A test."]
splits = { test = "train" }

[[dataset]]
name = "measured"
title = "Measured"
source = { path = "measured" }

[[dataset]]
name = "sim"
title = "Sim"
source = { path = "sim" }

[[frozen]]
name = "ours_v7"
title = "Ours 7"
detections = { measured = "dets/measured", sim = "dets/sim/result.pkl" }

[evaluation]
distances = { emd_points = 32, sinkhorn_points = 32, sinkhorn_iterations = 5, directions = 4 }

[evaluation.matrix.bootstrap]
replicates = 60
"#;

fn frames(folder: &Path) -> Vec<Frame> {
    let dataset = Dataset::open(folder).unwrap();
    dataset.ids("train").unwrap().iter().map(|id| dataset.load(id).unwrap()).collect()
}

/// Every labelled box is found `shift_m` too far to the left, and a box too many is found in each frame.
fn found(frame: &Frame, shift_m: f64) -> Vec<Detection> {
    let mut found: Vec<Detection> = Vec::new();
    for (i, object) in frame.objects.iter().enumerate() {
        let mut bbox = object.bbox;
        bbox.center[1] += shift_m;
        found.push(Detection { class: "Car".into(), bbox, score: 0.9 - 0.1 * i as f32 });
    }
    let mut alarm = frame.objects[0].bbox;
    alarm.center[0] += 30.0;
    found.push(Detection { class: "Car".into(), bbox: alarm, score: 0.3 });
    found
}

fn write_texts(folder: &Path, frames: &[Frame], change: impl Fn(&mut LabelBox)) {
    fs::create_dir_all(folder).unwrap();
    for frame in frames {
        let mut lines: Vec<LabelBox> =
            found(frame, 0.1).iter().map(|d| LabelBox::from_box(&d.class, &d.bbox, Some(d.score))).collect();
        lines.iter_mut().for_each(&change);
        fs::write(folder.join(format!("{}.txt", frame.id)), to_kitti_text(&lines)).unwrap();
    }
}

/// The data sets, the detections and the study.
fn study(folder: &Path) {
    for name in ["measured", "sim"] {
        fs::create_dir(folder.join(name)).unwrap();
        data_set(&folder.join(name));
    }
    let frames = frames(&folder.join("measured"));
    write_texts(&folder.join("dets/measured"), &frames, |_| {});
    fs::create_dir_all(folder.join("dets/sim")).unwrap();
    // The simulated cars are found 0.4 m off: not at overlap 0.7.
    let found: Vec<(String, Vec<Detection>)> = frames.iter().map(|f| (f.id.clone(), found(f, 0.4))).collect();
    fs::write(folder.join("dets/sim/result.pkl"), result_pkl(&found)).unwrap();
    fs::write(folder.join("frozen.toml"), STUDY).unwrap();
}

fn page(folder: &Path) -> String {
    fs::read_to_string(folder.join("runs/frozen/report.html")).unwrap()
}

#[test]
fn detections_made_elsewhere_are_a_study_without_training() {
    let dir = tempfile::tempdir().unwrap();
    study(dir.path());
    let text = output_text(&must(dir.path(), "study frozen.toml"));
    for part in [
        "Ours 7, Car 3D AP (0.5): Measured",
        "Ours 7, Car 3D AP (0.7): Measured",
        "over 5 frames",
        "| Ours 7 | elsewhere | Measured | 1 of 1 |",
        "| Ours 7 | elsewhere | Sim | 1 of 1 |",
    ] {
        assert!(text.contains(part), "no {part:?} in: {text}");
    }
    let html = page(dir.path());
    for part in ["Measured minus simulated", "Ours 7, trained elsewhere, to Sim", "Chamfer"] {
        assert!(html.contains(part), "{part} is not in the report");
    }
    let forms = forms::check_files(&dir.path().join("runs/frozen"), &[]);
    assert!(["paired", "frozen-cell"].iter().all(|form| forms.contains(*form)), "{forms:?}");
    let paired: serde_json::Value =
        serde_json::from_slice(&fs::read(dir.path().join("runs/frozen/paired.json")).unwrap()).unwrap();
    let of = |overlap: f64| {
        let all = paired[0].as_array().unwrap().iter();
        let is = |d: &&serde_json::Value| {
            d["overlap"] == overlap && d["quantity"] == "recall_matched" && d["section"].is_null()
        };
        all.clone().find(is).unwrap().clone()
    };
    let (loose, strict) = (of(0.5), of(0.7));
    assert_eq!((loose["value"].as_f64(), loose["other"].as_f64()), (Some(100.0), Some(100.0)), "{loose}");
    assert_eq!((strict["value"].as_f64(), strict["other"].as_f64()), (Some(100.0), Some(0.0)), "{strict}");
    assert_eq!(strict["interval"]["low"].as_f64(), Some(100.0), "{strict}");
    let status = output_text(&must(dir.path(), "study status frozen.toml"));
    assert!(status.contains("frozen ours_v7 on measured: read"), "{status}");

    // A second call finds everything and writes the same page; changed detections are read again.
    let again = output_text(&must(dir.path(), "study frozen.toml"));
    assert!(!again.contains("reading its detections") && page(dir.path()) == html, "{again}");
    let path = dir.path().join("dets/measured/000001.txt");
    let half = fs::read_to_string(&path).unwrap().lines().next().unwrap().to_string();
    fs::write(&path, half).unwrap();
    let status = output_text(&must(dir.path(), "study status frozen.toml"));
    assert!(status.contains("on measured: its detections have not been read yet, or have changed"), "{status}");
    let again = output_text(&must(dir.path(), "study frozen.toml"));
    assert!(again.contains("reading its detections on measured") && !again.contains("on sim\n"), "{again}");
    assert!(page(dir.path()) != html);
}

#[test]
fn cells_of_tables_are_no_formulas() {
    let dir = tempfile::tempdir().unwrap();
    study(dir.path());
    let text = STUDY.replace("title = \"Sim\"", "title = \"=1+1\"").replace("title = \"Ours 7\"", "title = \"=2+2\"");
    fs::write(dir.path().join("frozen.toml"), text).unwrap();
    must(dir.path(), "study frozen.toml");
    must(dir.path(), "eval matrix frozen.toml --csv numbers.csv");
    let tables = fs::read_dir(dir.path().join("runs/frozen/tables")).unwrap().map(|entry| entry.unwrap().path());
    let tables: Vec<_> = tables.filter(|path| path.extension().is_some_and(|e| e == "csv")).collect();
    assert!(!tables.is_empty());
    let mut named = 0;
    for path in tables.into_iter().chain([dir.path().join("numbers.csv")]) {
        let text = fs::read_to_string(&path).unwrap();
        named += text.matches("'=1+1").count() + text.matches("'=2+2").count();
        let is_formula =
            text.lines().flat_map(|line| line.split(',')).any(|cell| cell.trim_matches('"').starts_with('='));
        assert!(!is_formula, "{}: {text}", path.display());
    }
    assert!(named > 0, "no table names the data set");
}

/// The labels of `measured` are made wrong; the true boxes lie beside them.
#[test]
fn the_difference_is_split_where_the_truth_is_known() {
    let dir = tempfile::tempdir().unwrap();
    study(dir.path());
    let measured = dir.path().join("measured");
    let frames = frames(&measured);
    for folder in ["true", "repaired", "repaired_low", "repaired_high"] {
        fs::create_dir(measured.join(folder)).unwrap();
        for frame in &frames {
            let name = format!("{}.txt", frame.id);
            fs::copy(measured.join("label_2").join(&name), measured.join(folder).join(&name)).unwrap();
        }
    }
    for frame in &frames {
        let path = measured.join(format!("label_2/{}.txt", frame.id));
        let moved = |object: &data::Object| {
            let mut bbox = object.bbox;
            bbox.center[0] += 1.2;
            LabelBox::from_box(&object.class, &bbox, None)
        };
        fs::write(path, to_kitti_text(&frame.objects.iter().map(moved).collect::<Vec<_>>())).unwrap();
    }
    let toml = |keys: &str| {
        let text = format!("layout = \"kitti\"\nlabel_frame = \"lidar\"\nclasses = [\"Car\"]\n{keys}");
        fs::write(measured.join("dataset.toml"), text).unwrap();
    };
    for (keys, title) in
        [("true_labels = \"true\"\n", "true boxes"), ("repaired_labels = \"repaired\"\n", "repaired labels")]
    {
        toml(keys);
        let text = output_text(&must(dir.path(), "study frozen.toml"));
        assert!(text.contains(&format!("| Ours 7 | elsewhere | Measured, {title} | 1 of 1 |")), "{text}");
        let html = page(dir.path());
        assert!(html.contains("What makes the differences"), "{title}");
        assert!(html.contains(&format!("trained elsewhere, to Measured, {title}")), "{title}");
        let paired: serde_json::Value =
            serde_json::from_slice(&fs::read(dir.path().join("runs/frozen/paired.json")).unwrap()).unwrap();
        let is =
            |d: &&serde_json::Value| d["overlap"] == 0.5 && d["quantity"] == "recall_matched" && d["section"].is_null();
        let found = paired[0].as_array().unwrap().iter().find(is).unwrap();
        // All cars are found on both, but none of the measured ones at its label.
        assert_eq!((found["value"].as_f64(), found["other"].as_f64()), (Some(0.0), Some(100.0)), "{found}");
        let part = |name: &str| found["parts"][name]["points"].as_f64();
        assert_eq!((part("label"), part("sensor_and_scene")), (Some(-100.0), Some(0.0)), "{found}");
    }
    // A frame that the diagnosis did not see is an error that names it.
    fs::remove_file(measured.join("repaired_low/000001.txt")).unwrap();
    let output = run(dir.path(), "study frozen.toml");
    let text = output_text(&output);
    assert!(output.status.code() == Some(1) && text.contains("repaired_low/000001.txt"), "{text}");
}

#[test]
fn a_checkpoint_made_elsewhere_is_evaluated_on_every_data_set() {
    let dir = tempfile::tempdir().unwrap();
    study(dir.path());
    must(&dir.path().join("measured"), "train --dataset . --detector tiny.toml --epochs 1 --out run");
    let frozen = "[[frozen]]\nname = \"older\"\ncheckpoint = \"measured/run/checkpoint/last.safetensors\"\n\
                  detector = \"measured/tiny.toml\"\n\n[evaluation]";
    fs::write(dir.path().join("frozen.toml"), STUDY.replace("[evaluation]", frozen)).unwrap();
    let text = output_text(&must(dir.path(), "study frozen.toml"));
    assert!(text.contains("frozen older: detecting with its checkpoint"), "{text}");
    assert!(text.contains("| older | elsewhere | Sim | 1 of 1 |"), "{text}");
    let detections = dir.path().join("runs/frozen/frozen/older/detections");
    // Both data sets hold the same clouds.
    let of = |set: &str| {
        let file = detections.join(set).join("detections.parquet");
        data::read_detections_file(&file, &["000003"]).unwrap().frames[0].clone().unwrap()
    };
    assert_eq!(of("measured"), of("sim"));
    let again = output_text(&must(dir.path(), "study frozen.toml"));
    assert!(!again.contains("detecting with its checkpoint"), "{again}");

    // Weights of another network.
    let other = STUDY.replace("[evaluation]", &frozen.replace("tiny.toml", "tiny_pointrcnn.toml"));
    fs::write(dir.path().join("frozen.toml"), other).unwrap();
    let output = run(dir.path(), "study frozen.toml");
    let text = output_text(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("last.safetensors does not fit the detector tiny_pointrcnn"), "{text}");
}

#[test]
fn a_file_of_detections_is_read_as_a_folder_of_text() {
    let dir = tempfile::tempdir().unwrap();
    study(dir.path());
    let paired = || fs::read_to_string(dir.path().join("runs/frozen/paired.json")).unwrap();
    must(dir.path(), "study frozen.toml");
    let of_text = paired();
    let texts = dir.path().join("dets/measured");
    let mut frames: Vec<(String, Vec<LabelBox>)> = frames(&dir.path().join("measured"))
        .iter()
        .map(|frame| {
            let text = texts.join(format!("{}.txt", frame.id));
            (frame.id.clone(), data::read_kitti_text(&text, data::KittiText::Detections).unwrap())
        })
        .collect();
    let file = dir.path().join("dets/ours.parquet");
    let write = |frames: &[(String, Vec<LabelBox>)]| {
        let fill = |to: &mut data::DetectionsWriter<'_>| frames.iter().try_for_each(|(id, boxes)| to.frame(id, boxes));
        data::write_detections::<data::DataError>(&file, fill).unwrap();
    };
    write(&frames);
    toml("dets/measured", "dets/ours.parquet")(dir.path());
    let text = output_text(&must(dir.path(), "study frozen.toml"));
    assert!(text.contains("reading its detections on measured"), "{text}");
    assert_eq!(paired(), of_text);

    let left = frames.pop().unwrap();
    for (id, wanted) in [
        ("999", "ours.parquet: frame 999: data set measured has no such frame; 1 of"),
        ("", "does not exist; 1 of the"),
    ] {
        let more = (!id.is_empty()).then(|| [left.clone(), (id.to_string(), left.1.clone())]);
        write(&[&frames[..], more.as_ref().map_or(&[], |more| &more[..])].concat());
        let output = run(dir.path(), "study frozen.toml");
        let text = output_text(&output);
        assert_eq!(output.status.code(), Some(1), "{text}");
        assert!(text.contains(wanted), "no {wanted:?} in: {text}");
    }
}

/// Spoils the study, runs it, and checks that it fails with each text of `wanted`.
fn check(spoil: impl Fn(&Path), wanted: &[&str]) {
    let dir = tempfile::tempdir().unwrap();
    study(dir.path());
    spoil(dir.path());
    let output = run(dir.path(), "study frozen.toml");
    let text = output_text(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(!text.contains("panicked"), "{text}");
    for piece in wanted {
        assert!(text.contains(piece), "no {piece:?} in: {text}");
    }
}

fn toml(from: &str, to: &str) -> impl Fn(&Path) {
    assert!(STUDY.contains(from), "{from}");
    let text = STUDY.replacen(from, to, 1);
    move |folder| fs::write(folder.join("frozen.toml"), &text).unwrap()
}

#[test]
fn detections_that_do_not_fit_are_refused() {
    let text = |name: &str, content: &str| {
        let (name, content) = (name.to_string(), content.to_string());
        move |f: &Path| fs::write(f.join("dets/measured").join(&name), &content).unwrap()
    };
    let line = "Car -1 -1 -10 0 0 50 50 1.56 1.6 3.9 3 0 -1 0.1 0.5";
    check(text("000099.txt", line), &["dets/measured/000099.txt", "no such frame", "1 of 6 frames"]);
    check(
        |f| fs::remove_file(f.join("dets/measured/000002.txt")).unwrap(),
        &["dets/measured/000002.txt: does not exist; 1 of the 5 test frames", "empty file"],
    );
    let unknown = format!("{line}\n\n{}\n", line.replace("Car", "vehicle"));
    check(text("000002.txt", &unknown), &["000002.txt:3: class \"vehicle\" is not one of data set measured (Car)"]);
    check(text("000002.txt", &unknown), &["classes = { \"vehicle\" = \"Car\" }", "ignored_classes = [\"vehicle\"]"]);
    check(text("000002.txt", &line.replace(" 0.5", "")), &["000002.txt:1: a detection has 16 values"]);
    check(
        |f| fs::remove_dir_all(f.join("dets/measured")).unwrap(),
        &["dets/measured", "dets/measured: does not exist"],
    );
    check(
        |f| fs::write(f.join("dets/sim/result.pkl"), b"\x80\x04cos\nsystem\n.").unwrap(),
        &["result.pkl", "os.system"],
    );
    check(|f| fs::write(f.join("dets/sim/result.pkl"), "no").unwrap(), &["result.pkl: is not a pickle"]);
    let pickled = |change: fn(&mut Vec<(String, Vec<Detection>)>)| {
        move |f: &Path| {
            let mut all: Vec<_> =
                frames(&f.join("sim")).iter().map(|frame| (frame.id.clone(), found(frame, 0.4))).collect();
            change(&mut all);
            fs::write(f.join("dets/sim/result.pkl"), result_pkl(&all)).unwrap();
        }
    };
    check(pickled(|all| all[1].0 = "000777".into()), &["result.pkl: frame 000777: data set sim has no such frame"]);
    check(pickled(|all| drop(all.pop())), &["result.pkl: frame", "1 of the 5 test frames of data set sim"]);
    check(
        pickled(|all| all[3].1[1].class = "Lorry".into()),
        &["result.pkl: frame 000003, detection 1: class \"Lorry\" is not one of data set sim (Car)"],
    );
    check(pickled(|all| all[2].1[0].score = f32::NAN), &["frame 000002 (entry 2 of the list): detection 0: NaN"]);
}

#[test]
fn renamed_and_ignored_classes_and_ids_without_zeros_are_accepted() {
    let dir = tempfile::tempdir().unwrap();
    study(dir.path());
    let mut all: Vec<_> =
        frames(&dir.path().join("sim")).iter().map(|frame| (frame.id.clone(), found(frame, 0.4))).collect();
    for (id, found) in &mut all {
        *id = id.trim_start_matches('0').to_string();
        if id.is_empty() {
            *id = "0".into();
        }
        found.iter_mut().for_each(|d| d.class = "vehicle".into());
        let mut bird = found[0].clone();
        bird.class = "bird".into();
        found.push(bird);
    }
    fs::write(dir.path().join("dets/sim/result.pkl"), result_pkl(&all)).unwrap();
    let keys = "title = \"Ours 7\"\nclasses = { vehicle = \"Car\" }\nignored_classes = [\"bird\"]\n";
    fs::write(dir.path().join("frozen.toml"), STUDY.replace("title = \"Ours 7\"\n", keys)).unwrap();
    let text = output_text(&must(dir.path(), "study frozen.toml"));
    assert!(text.contains("| Ours 7 | elsewhere | Sim | 1 of 1 |"), "{text}");
}

#[test]
fn boxes_in_another_frame_are_found_by_their_overlap() {
    type Wrong = fn(&mut LabelBox);
    let cases: [(Wrong, &str); 5] = [
        (
            |d| {
                d.location[1] = -d.location[1];
                d.rotation_y = -d.rotation_y;
            },
            "after mirroring y",
        ),
        (
            |d| {
                d.location = [-d.location[1], d.location[0], d.location[2]];
                d.rotation_y += std::f64::consts::FRAC_PI_2;
            },
            "after turning by 90 degrees clockwise",
        ),
        (
            |d| {
                d.location = [-d.location[0], -d.location[1], d.location[2]];
                d.rotation_y += std::f64::consts::PI;
            },
            "after turning by 180 degrees",
        ),
        (
            |d| {
                let [x, y, z] = d.location;
                d.location = [-y, -z + d.size_hwl[0] / 2.0, x];
                d.rotation_y = -d.rotation_y - std::f64::consts::FRAC_PI_2;
            },
            "after reading the columns in the other label frame",
        ),
        (|d| d.location[2] -= d.size_hwl[0] / 2.0, "after raising boxes by half of their height"),
    ];
    for (wrong, wanted) in cases {
        let spoil = |f: &Path| write_texts(&f.join("dets/measured"), &frames(&f.join("measured")), wrong);
        check(
            spoil,
            &["dets/measured", "not in the frame of the labels", "of 7 labels in 5 frames", wanted, "7. Correct"],
        );
    }
}

#[test]
fn studies_that_cannot_be_evaluated_are_refused() {
    for (from, to, wanted) in [
        ("sim = \"dets/sim/result.pkl\"", "other = \"dets/sim\"", "detections contains \"other\""),
        ("detections = {", "checkpoint = \"a.pth\"\ndetections = {", "give either detections, or both others"),
        ("detections = { measured = \"dets/measured\", sim = \"dets/sim/result.pkl\" }", "", "has neither detections"),
        ("[[frozen]]\nname = \"ours_v7\"", "[[frozen]]\nname = \"../ours\"", "has to be a file name"),
        ("title = \"Ours 7\"", "tytle = \"Ours 7\"", "frozen.toml:18: unknown field `tytle`"),
        ("name = \"sim\"\n", "name = \"elsewhere\"\n", "detections contains \"sim\""),
        ("sim = \"dets/sim/result.pkl\"", "sim = \"dets/none.pkl\"", "dets/none.pkl"),
    ] {
        check(toml(from, to), &[wanted]);
    }
    // No frame is in both data sets.
    check(
        |f| {
            for i in 0..7 {
                for (folder, ending) in [("velodyne", "bin"), ("label_2", "txt")] {
                    let path = |i: usize| f.join(format!("sim/{folder}/{i:06}.{ending}"));
                    fs::rename(path(i), path(i + 100)).unwrap();
                }
            }
            let ids: Vec<String> = (100..105).map(|i| format!("{i:06}\n")).collect();
            fs::write(f.join("sim/ImageSets/train.txt"), ids.concat()).unwrap();
        },
        &[
            "sim/ImageSets/train.txt: none of its 5 frames is among the 5 of",
            "measured/ImageSets/train.txt",
            "the same frame ids",
        ],
    );
}

#[test]
fn simulations_are_ranked_over_the_same_frames() {
    let dir = tempfile::tempdir().unwrap();
    study(dir.path());
    fs::create_dir(dir.path().join("sim-b")).unwrap();
    data_set(&dir.path().join("sim-b"));
    // Another sensor: points that are 5 cm off.
    for i in 0..7 {
        let path = dir.path().join(format!("sim-b/velodyne/{i:06}.bin"));
        let mut bytes = fs::read(&path).unwrap();
        for point in bytes.chunks_exact_mut(16) {
            let x = f32::from_le_bytes(point[..4].try_into().unwrap()) + 0.05;
            point[..4].copy_from_slice(&x.to_le_bytes());
        }
        fs::write(&path, bytes).unwrap();
    }
    let compare = "compare measured sim sim-b --split train --distance-frames 2 --out runs/c --json c.json \
                   --detections ours=dets/measured,dets/sim/result.pkl,dets/measured";
    let text = output_text(&must(dir.path(), compare));
    assert!(text.contains("mean gap of 3D AP over 2 values (detectors, classes, overlaps) (5 frames)"), "{text}");
    assert!(text.contains("1. sim-b: 0.0000 points") && text.contains("2. sim: "), "{text}");
    let html = fs::read_to_string(dir.path().join("runs/c/comparison.html")).unwrap();
    for part in ["The order", "Detector gap", "Distances between the clouds", "sim-b", "ours: 3D AP (0.7) of Car"] {
        assert!(html.contains(part), "{part} is not on the page");
    }
    let found: eval::comparison::Comparison =
        serde_json::from_slice(&fs::read(dir.path().join("c.json")).unwrap()).unwrap();
    assert_eq!(found.order, ["sim-b", "sim"]);
    let strict = found.criteria.iter().find(|c| c.name == "ours: Recall, matched (0.7) of Car");
    let strict = &strict.unwrap().rows[0];
    assert_eq!((strict.difference, strict.rank, strict.first_share), (Some(100.0), Some(2), Some(0.0)));
    assert_eq!(strict.behind_interval.map(|i| i.low), Some(100.0));
    let distance = found.criteria.iter().find(|c| c.kind == eval::comparison::CriterionKind::Distance).unwrap();
    assert_eq!(distance.rows[0].size, Some(0.0), "sim has the clouds of the measured data");
    assert_eq!((distance.frames, distance.rows[1].rank), (2, Some(2)));

    // The folder is a study.
    let text = output_text(&must(dir.path(), "report runs/c"));
    assert!(text.contains("report.html"), "{text}");

    for (arguments, wanted) in [
        (
            "compare measured sim --split train --detections ours=dets/measured",
            "has 1 paths for 2 data sets (measured, sim)",
        ),
        ("compare measured sim --split train --detections dets/measured", "has to be NAME=PATH,PATH"),
        ("compare measured sim --split train --distance-frames 0", "there is nothing to compare by"),
        ("compare measured sim --split test", "no split \"test\""),
        ("compare measured nowhere --split train", "nowhere"),
    ] {
        let output = run(dir.path(), arguments);
        let text = output_text(&output);
        assert!(output.status.code() == Some(1) && text.contains(wanted), "{arguments}: {text}");
    }
    for (i, set) in ["sim", "sim-b"].iter().enumerate() {
        let ids = fs::read_to_string(dir.path().join("measured/ImageSets/train.txt")).unwrap();
        let ids: Vec<&str> = ids.lines().collect();
        fs::write(dir.path().join(set).join("ImageSets/train.txt"), ids[2 * i..2 * i + 2].join("\n")).unwrap();
    }
    let output = run(dir.path(), "compare measured sim sim-b --split train");
    let text = output_text(&output);
    assert!(
        output.status.code() == Some(1) && text.contains("no frame of split \"train\" is in all data sets"),
        "{text}"
    );
}
