use super::*;
use proptest::prelude::*;

macro_rules! golden {
    ($name:literal) => {
        include_bytes!(concat!("../../../../tests/golden/results/", $name, ".pkl"))
    };
}

fn read(bytes: &[u8]) -> Result<Vec<FrameResult>, String> {
    parse_results(Path::new("result.pkl"), bytes).map_err(|e| e.to_string())
}

/// The detections of `make_results.py`: boxes of row k from x = `first` on, in these classes.
fn made(classes: &[&str], first: f64) -> Vec<Detection> {
    let of = |(k, class): (usize, &&str)| Detection {
        class: (*class).into(),
        bbox: Box3::from_array([first + 10.0 * k as f64, -1.5 * k as f64, -0.75, 4.0, 1.75, 1.5, 0.25 * k as f64]),
        score: 1.0 - k as f32 / 4.0,
    };
    classes.iter().enumerate().map(of).collect()
}

#[test]
fn files_of_both_numpys_and_all_protocols() {
    for bytes in [
        &golden!("numpy1_protocol2")[..],
        golden!("numpy1_protocol4"),
        golden!("numpy1_protocol5"),
        golden!("numpy2_protocol2"),
        golden!("numpy2_protocol4"),
        golden!("numpy2_protocol5"),
    ] {
        let frames = read(bytes).unwrap();
        let ids: Vec<&str> = frames.iter().map(|f| f.frame_id.as_str()).collect();
        assert_eq!(ids, ["000000", "000001", "000007"]);
        assert_eq!(frames[0].detections, made(&["Car", "Pedestrian", "Car"], 10.0));
        assert_eq!(frames[1].detections, []);
        assert_eq!(frames[2].detections, made(&["Car"], 20.0));
    }
}

#[test]
fn other_forms_of_arrays() {
    let frames = read(golden!("numpy2_other_forms")).unwrap();
    let ids: Vec<&str> = frames.iter().map(|f| f.frame_id.as_str()).collect();
    assert_eq!(ids, ["5", "000006", "7", "000008"]);
    for frame in &frames {
        assert_eq!(frame.detections, made(&["Car", "Car"], 10.0), "frame {}", frame.frame_id);
    }
}

/// The golden file of protocol 4 with one piece replaced by another of the same length.
fn changed(from: &[u8], to: &[u8]) -> Result<Vec<FrameResult>, String> {
    assert_eq!(from.len(), to.len());
    let mut bytes = golden!("numpy2_protocol4").to_vec();
    let at = bytes.windows(from.len()).position(|w| w == from).expect("the piece is in the file");
    bytes[at..at + to.len()].copy_from_slice(to);
    read(&bytes)
}

#[test]
fn damaged_files_are_refused() {
    let f32s = |values: [f32; 3]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let scores = f32s([1.0, 0.75, 0.5]);
    for (from, to, wanted) in [
        (&b"frame_id"[..], &b"frame_no"[..], "entry 0 of the list: has no frame_id"),
        (b"boxes_lidar", b"boxes_camer", "frame 000000 (entry 0 of the list): has no boxes_lidar"),
        (b"000007", b"000000", "frame 000000 occurs twice: entries 0 and 2"),
        (&scores, &f32s([1.0, f32::NAN, 0.5]), "detection 1: NaN in its box or score is not a finite number"),
        (&scores, &f32s([1.0, 0.75, f32::INFINITY]), "detection 2: inf"),
        (b"_reconstruct", b"_destruction", "asks for numpy._core.multiarray._destruction"),
        (b"numpy._core.multiarray", b"numpy._core.multiarrax", "asks for numpy._core.multiarrax"),
        (b"\x8c\x02f4", b"\x8c\x02c4", "boxes_lidar has elements of the type \"c4\""),
        (b"\x8c\x03U10", b"\x8c\x03U11", "is an array of shape [3] whose content has another size"),
    ] {
        let error = changed(from, to).unwrap_err();
        assert!(error.starts_with("result.pkl: ") && error.contains(wanted), "{error}, not {wanted}");
    }
    for (bytes, wanted) in [
        (&b""[..], "is empty"),
        (b"Car -1 -1", "is not a pickle"),
        (b"\x80\x04}.", "is not a list of frames"),
        (b"\x80\x04]].", "ends too early"),
        (b"\x80\x04].N.", "2 bytes follow"),
        (b"\x80\x04](]e.", "entry 0 of the list: is not a dictionary"),
        (b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x02ls\x85R.", "asks for os.system"),
        (b"\x80\x04cbuiltins\neval\n.", "asks for builtins.eval"),
    ] {
        let error = read(bytes).unwrap_err();
        assert!(error.contains(wanted), "{error}, not {wanted}");
    }
}

#[test]
fn a_small_file_cannot_ask_for_much_memory() {
    // The budget is checked before elements are read.
    let bytes = golden!("numpy2_protocol4");
    let mut budget = 2;
    let pickle = Pickle::parse(bytes, Contents::Arrays).unwrap();
    let Value::List(frames) = pickle.root() else { panic!() };
    let failed = frame(&pickle, frames[0], &mut budget).unwrap_err();
    assert!(failed.1.contains("than the file can hold"), "{}", failed.1);
}

#[test]
fn halves_are_exact() {
    for (bits, value) in
        [(0x3c00, 1.0), (0xc100, -2.5), (0x7bff, 65504.0), (0x0001, 2f64.powi(-24)), (0x0400, 2f64.powi(-14))]
    {
        assert_eq!(numpy::half(bits), value);
    }
    assert!(numpy::half(0x7c00).is_infinite() && numpy::half(0x7e00).is_nan());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]
    /// A truncated or changed file is read or refused, without a panic; what is read is valid.
    #[test]
    fn mutated_files_never_panic(
        file in 0usize..4,
        cut in 0.0f64..1.3,
        changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..4),
    ) {
        let bytes = [&golden!("numpy1_protocol2")[..], golden!("numpy2_protocol4"), golden!("numpy2_protocol5"), golden!("numpy2_other_forms")][file];
        let mut bytes = bytes.to_vec();
        bytes.truncate((bytes.len() as f64 * cut) as usize);
        for (at, value) in changes {
            if !bytes.is_empty() {
                let at = at.index(bytes.len());
                bytes[at] = value;
            }
        }
        for frame in read(&bytes).unwrap_or_default() {
            for detection in frame.detections {
                prop_assert!(detection.bbox.to_array().iter().all(|v| v.is_finite()) && detection.score.is_finite());
            }
        }
    }
}
