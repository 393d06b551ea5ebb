//! HELIOS++: a scanner and a platform for every sensor, as XML.
//!
//! Sources: `scanner.xsd` and `platform.xsd` in `python/pyhelios/util/xsd` of HELIOS++, `XmlAssetsLoader.cpp`, and the
//! scanners `vlp16` and `velodyne_hdl-64e` of `scanners_tls.xml`.

use crate::frames::{Head, Made, helios_mount};
use crate::number::number;
use crate::pattern::without_grid;
use crate::placement::Native;
use crate::plan::{Plan, SensorPlan, xml_text};
use sensor::Effect;
use std::fmt::Write;

pub(crate) fn take(effect: &Effect, plan: &mut Plan) -> Native {
    match effect {
        Effect::RangeNoise(e) => {
            plan.noise.push([0.0, e.std_m, 0.0]);
            Native::All("accuracy_m".into())
        }
        Effect::RangeLimits(e) => {
            for limits in plan.sensors.iter_mut().map(|s| &mut s.limits_m) {
                *limits = [limits[0].max(e.min_m), limits[1].min(e.max_m)];
            }
            Native::All("rangeMin_m, rangeMax_m".into())
        }
        Effect::SensorPoseError(e) => {
            plan.misplace(e);
            Native::All("scannerMount of the platform".into())
        }
        Effect::RollingShutter(e) if !e.deskewed && !e.only_objects && e.slide.is_none() => {
            plan.shutter = true;
            Native::All("the motion of the platform: every pulse has its own time".into())
        }
        Effect::BeamDivergence(e) => {
            plan.divergence_rad = plan.divergence_rad.max(e.divergence_rad);
            Native::About {
                by: "beamDivergence_rad, FWFSettings beamSampleQuality".into(),
                how: "ranges of a beam are put together from the waveform, not by the weights of the effect".into(),
            }
        }
        Effect::DualReturns(_) => {
            plan.returns = 2;
            Native::All("maxNOR".into())
        }
        Effect::RangeBias(_) => Native::Not("an element rangeError exists in the program, but not in its schema"),
        Effect::SignalDropout(_) | Effect::RangeDropout(_) => Native::Not(
            "the energy of the received light decides, by receivedEnergyMin_W, atmosphericVisibility_km and the \
             materials of the scene: set those for the detection without the effect",
        ),
        _ => Native::Not("has no attribute"),
    }
}

pub(crate) fn files(head: &Head, plan: &Plan) -> Made {
    let mut made = Made::default();
    made.not_expressed.extend(plan.sensors.iter().filter_map(without_grid));
    made.notes.extend(COMMENTS.iter().map(|c| c.to_string()));
    let lines: String = head.lines().iter().chain(&made.notes).map(|line| format!("  {}\n", xml_text(line))).collect();
    let document =
        |inside: String| format!("<?xml version=\"1.0\"?>\n<document>\n  <!--\n{lines}  -->\n{inside}</document>\n");
    let scanners = plan.sensors.iter().map(|s| scanner(s, plan)).collect();
    let platforms = plan.sensors.iter().map(platform).collect();
    made.files.push(("scanners.xml".into(), document(scanners)));
    made.files.push(("platforms.xml".into(), document(platforms)));
    made
}

const COMMENTS: &[&str] = &[
    "Frame of HELIOS++: x right, y forward, z up, m. The rig has x forward and y left: x = -y, y = x of the rig.",
    "Rotations are about fixed axes in the order of the file, degrees: roll about y, minus pitch about x, yaw about z.",
    "Mounts are true poses. The sensor reports its points by its nominal pose.",
    "A head of channels turns about z. A survey sets pulseFreq_hz, headRotatePerSec_deg, and headRotateStart_deg and \
     headRotateStop_deg for a field of view that is no full circle. They stand above each scanner.",
];

fn scanner(sensor: &SensorPlan, plan: &Plan) -> String {
    let name = sensor.xml_name();
    let per_channel = (f64::from(sensor.columns) * sensor.rate_hz * 360.0 / sensor.fov_deg.max(0.1)).round();
    let half = number(sensor.fov_deg / 2.0);
    let turn = number(360.0 * sensor.rate_hz);
    let mut text = format!(
        "  <!-- {name}: pulseFreq_hz=\"{per_channel}\" headRotatePerSec_deg=\"{turn}\" headRotateStart_deg=\"{half}\" \
         headRotateStop_deg=\"-{half}\" scanAngle_deg=\"0\" scanFreq_hz=\"0\" -->\n  <scanner id=\"{name}\" \
         name=\"{name}\" optics=\"rotating\" accuracy_m=\"{}\"\n           rangeMin_m=\"{}\" rangeMax_m=\"{}\" \
         maxNOR=\"{}\" scanAngleMax_deg=\"1\"\n           scanAngleEffectiveMax_deg=\"1\" scanFreqMin_Hz=\"0\" \
         scanFreqMax_Hz=\"0\" headRotatePerSecMax_deg=\"{turn}\"",
        number(plan.constant_noise_m()),
        number(sensor.limits_m[0]),
        number(sensor.limits_m[1]),
        plan.returns,
    );
    if sensor.columns > 0 {
        let _ = write!(text, "\n           pulseFreqs_Hz=\"{per_channel}\"");
    }
    if plan.divergence_rad > 0.0 {
        let _ = write!(text, " beamDivergence_rad=\"{}\"", number(plan.divergence_rad));
    }
    let quality = if plan.divergence_rad > 0.0 { 3 } else { 1 };
    let _ = write!(
        text,
        ">\n    <beamOrigin x=\"0\" y=\"0\" z=\"0\"/>\n    <headRotateAxis x=\"0\" y=\"0\" z=\"1\"/>\n    \
         <FWFSettings beamSampleQuality=\"{quality}\"/>\n"
    );
    if !sensor.rows_deg.is_empty() {
        text.push_str("    <channels>\n");
        for (row, deg) in sensor.rows_deg.iter().enumerate() {
            let _ = write!(
                text,
                "      <channel id=\"{row}\">\n        <beamOrigin x=\"0\" y=\"0\" z=\"0\"><rot axis=\"x\" \
                 angle_deg=\"{}\"/></beamOrigin>\n      </channel>\n",
                number(*deg)
            );
        }
        text.push_str("    </channels>\n");
    }
    text.push_str("  </scanner>\n");
    text
}

fn platform(sensor: &SensorPlan) -> String {
    let mount = |pose| helios_mount(pose).map(number);
    let [x, y, z, roll, pitch, yaw] = mount(&sensor.mount);
    let nominal = mount(&sensor.nominal).join(" ");
    format!(
        "  <!-- nominal mount: {nominal} -->\n  <platform id=\"mount_{0}\" name=\"{0}\" type=\"linearpath\">\n    \
         <scannerMount x=\"{x}\" y=\"{y}\" z=\"{z}\" rotations=\"global\">\n      <rot axis=\"y\" \
         angle_deg=\"{roll}\"/>\n      <rot axis=\"x\" angle_deg=\"{pitch}\"/>\n      <rot axis=\"z\" \
         angle_deg=\"{yaw}\"/>\n    </scannerMount>\n  </platform>\n",
        sensor.xml_name()
    )
}
